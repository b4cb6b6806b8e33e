"""Checks of the settings, made before anything is compiled."""

from cref_jax.config.settings import Config
from cref_jax.errors import ConfigError


def check(c: Config) -> None:
    """Refuse settings that cannot run.

    Raises:
        ConfigError: says which setting, and what would be right.
    """
    positive = {
        "run.num_envs": c.run.num_envs,
        "run.iterations": c.run.iterations,
        "run.chunk": c.run.chunk,
        "ppo.horizon": c.ppo.horizon,
        "ppo.epochs": c.ppo.epochs,
        "ppo.minibatches": c.ppo.minibatches,
        "physics.substeps": c.physics.substeps,
        "terrain.levels": c.terrain.levels,
        "terrain.variants": c.terrain.variants,
        "reward.debounce": c.reward.debounce,
        "episode.bank_size": c.episode.bank_size,
    }
    for name, value in positive.items():
        if value < 1:
            raise ConfigError(f"'{name}' must be at least 1, not {value}")
    robots, parts = c.run.num_envs, c.ppo.minibatches
    if robots % parts:
        below, above = robots // parts * parts, -(-robots // parts) * parts
        near = f"{below} or {above}" if below else f"{above}"
        raise ConfigError(f"{robots} robots do not split into {parts} minibatches; take {near}")
    if c.camera.window < 1 or c.camera.window % 2 == 0:
        raise ConfigError(f"'camera.window' must be 1, 3, 5, ..., not {c.camera.window}")
    if not 1e-4 <= c.physics.timestep <= 0.02:
        raise ConfigError(f"'physics.timestep' must be 0.0001 to 0.02 s, not {c.physics.timestep}")
