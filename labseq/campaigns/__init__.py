"""Campaigns: many runs of a sequence, taken by this computer or a cluster, and read as one."""
