"""Serves devices of this computer to another one that runs sequences; keys of computers."""
