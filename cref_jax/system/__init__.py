"""The process around the program: its environment, JAX, signals and worker processes."""
