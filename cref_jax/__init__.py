"""Depth-conditioned humanoid locomotion (CReF) as one jitted JAX program."""
