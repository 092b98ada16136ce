"""Reads YAML files into frozen, validated settings. Errors name the file, line and column."""
