"""`labseq plan` and `labseq waveform`: one plan, and what the AWG plays for it, printed, drawn and saved."""
