"""Nothing stays on: locks on devices, making them safe, and checking them one by one."""
