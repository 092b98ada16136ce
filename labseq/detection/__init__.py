"""From a frame to an occupancy, or to the lattice and the light of its spots."""
