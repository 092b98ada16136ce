"""Bridges to labseq inside other control systems, such as ARTIQ, labscript and anything with ZeroMQ.

Copy this folder and labseq_client.py to the computer of the control system, which does not need labseq.
"""
