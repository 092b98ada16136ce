"""Planners, rendering and latency compared without a run."""
