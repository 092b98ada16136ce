"""Benchmarks of planners, rendering and latency, without a run."""
