"""What runs have recorded, worked out and drawn: statistics, plots, replay."""
