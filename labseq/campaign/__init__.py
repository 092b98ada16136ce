"""Parameter campaigns: one run for each point of a grid; and the certificates of clusters."""
