"""Reads recorded runs, in progress or finished: shots, quantities, tables, exports."""
