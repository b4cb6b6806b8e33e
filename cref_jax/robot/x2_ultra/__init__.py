"""The AGIBOT X2 Ultra: its model file, and the rest of it as data."""
