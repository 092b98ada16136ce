"""Shared code of camera drivers, and of drivers for devices that run in real time.

A driver need not use it, because it only has to fulfil its role. But a camera's series, its limits,
its lost frames and its errors are the same for all cameras, and are handled here.
"""
