"""Pictures of plans, targets and waveforms."""
