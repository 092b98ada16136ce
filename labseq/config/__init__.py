"""Reads YAML files into frozen, validated settings; errors name file, line and column."""
