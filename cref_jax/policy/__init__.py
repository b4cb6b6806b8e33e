"""A trained policy: where it comes from, and how it is exported and read back."""
