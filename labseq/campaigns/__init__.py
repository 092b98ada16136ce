"""Campaigns: many runs of a sequence, by this computer or a cluster, and read as one."""
