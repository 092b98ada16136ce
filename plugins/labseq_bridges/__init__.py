"""Ends of labseq inside other control systems: ARTIQ, labscript, and anything that speaks ZeroMQ.

Copy this folder and labseq_client.py to the computer of the control system; labseq need not be there.
"""
