"""`labseq plan` and `labseq waveform`, which print, draw and save a plan and its AWG output."""
