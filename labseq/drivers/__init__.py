"""What the drivers of cameras, and of devices that run in real time, have in common.

A driver need not use any of it: it only has to fulfil its role. But a camera's series, its limits,
its lost frames and its errors are the same for all cameras, and are handled once, here.
"""
