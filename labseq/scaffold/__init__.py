"""`labseq new` and the schemas of files for editors."""
