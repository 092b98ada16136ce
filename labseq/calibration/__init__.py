"""Calibrations: their measurement, analysis, store, pictures and commands."""
