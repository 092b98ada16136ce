"""Compiled kernels: pure functions on contiguous arrays and numbers.

Importing this package costs nothing; importing one of its kernel modules imports
numba and compiles the module, or loads it from the user's cache.
"""
