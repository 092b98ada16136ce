"""A labscript device of labseq: BLACS hands values to labseq before each shot, and keeps its answer after it.

Copy this folder to `user_devices`, under any name, and `labseq_client.py` to `pythonlib`.
"""
