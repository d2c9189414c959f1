"""Devices: what they are called, what they can do, and how they fail."""
