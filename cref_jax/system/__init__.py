"""The process around the program: its environment, JAX, signals, worker processes and files."""
