"""The process that keeps a software-defined radio supplied with samples, for ``labseq_soapy``.

It imports nothing of labseq, so that it starts soon.
"""
