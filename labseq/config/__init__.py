"""YAML to frozen, validated specs, with errors that name file, line and column."""
