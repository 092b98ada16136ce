"""The parallel sort-and-compression algorithm."""
