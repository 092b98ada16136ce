"""`labseq new`, the schemas of files for editors, and the reference."""
