"""The Unitree G1: its model file, and the rest of it as data."""
