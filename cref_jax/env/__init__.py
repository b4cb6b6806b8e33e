"""The environment: observations, commands, rewards, terminations, resets and curriculum."""
