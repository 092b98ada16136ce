"""Locks devices, makes them safe so that nothing stays on, and checks them one by one."""
