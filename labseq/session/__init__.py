"""Builds a run from a sequence, a profile and plugins, opens the devices, takes the shots and records them.

``labseq check`` is in ``check``. Planning without a run is in ``planning``, with its ``occupancies``.
"""
