"""Evaluates recorded runs: statistics, plots and replay."""
