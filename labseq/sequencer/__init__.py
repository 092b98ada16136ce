"""Runs shots, with declared states, retries, and the safe state however a run ends.

Depends on the roles only, not on plugins, files, YAML or numba.
"""
