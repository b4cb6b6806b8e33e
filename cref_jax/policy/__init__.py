"""A trained policy: its sources, its export and its import."""
