"""Compiled functions: the decorator with its cache, and C, clocks and signals for compiled code."""
