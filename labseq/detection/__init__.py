"""Turns a frame into an occupancy, or into the lattice and the light of its spots."""
