"""A queue of runs that are taken one after the other."""
