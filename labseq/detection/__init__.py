"""From a frame to an occupancy."""
