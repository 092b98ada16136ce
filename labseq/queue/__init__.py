"""Runs taken one after the other."""
