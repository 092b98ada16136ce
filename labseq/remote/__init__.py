"""Serves devices of this computer to another computer that runs sequences, and manages keys."""
