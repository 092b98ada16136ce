"""Virtual hardware on one simulated world."""
