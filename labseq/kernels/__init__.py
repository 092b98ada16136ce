"""Compiles functions with a cache, and gives compiled code access to C, clocks and signals."""
