"""A labscript device of labseq. BLACS sends values to labseq before each shot, and stores the answer.

Copy this folder to `user_devices`, under any name, and `labseq_client.py` to `pythonlib`.
"""
