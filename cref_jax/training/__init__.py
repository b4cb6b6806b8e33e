"""Collecting experience, learning from it, and what a run leaves on disk."""
