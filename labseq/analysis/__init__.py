"""Evaluates recorded runs: statistics, plots, replay."""
