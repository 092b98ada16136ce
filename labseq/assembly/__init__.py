"""Turns files into objects: validates settings, and chooses and constructs plugins. Opens no device."""
