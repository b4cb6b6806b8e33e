"""Checks of the settings, made before anything is compiled."""

import math

from cref_jax.config.settings import Config
from cref_jax.errors import ConfigError

POSITIVE = (  # settings that are at least 1
    "run.num_envs", "run.iterations", "run.chunk", "run.keep",
    "ppo.horizon", "ppo.epochs", "ppo.minibatches",
    "physics.substeps", "physics.iterations", "physics.line_search",
    "terrain.levels", "terrain.variants",
    "reward.debounce", "episode.bank_size", "foothold.stride", "foothold.min_points",
    "network.token", "network.heads", "network.compressed", "network.lstm", "network.gru",
)  # fmt: skip
ABOVE_ZERO = (
    "camera.d_max", "camera.rate", "episode.length", "network.initial_std", "ppo.clip",
    "ppo.learning_rate", "ppo.target_kl", "ppo.max_gradient_norm",
    "reward.sigma_v", "reward.sigma_omega", "reward.foothold_tolerance",
)  # fmt: skip
COMPRESSION = 8  # pixels, side of the blocks of the depth compression
SHARES = (  # settings within [0, 1]
    "ppo.gamma", "ppo.lam", "command.standing", "command.zero", "command.lane_free",
    "curriculum.review", "episode.start_anywhere", "reward.soft_limit",
)  # fmt: skip


def check(c: Config) -> None:
    """Refuse settings that cannot run.

    Raises:
        ConfigError: says which setting, and what would be right.
    """
    for name in POSITIVE:
        if not _value(c, name) >= 1:
            raise ConfigError(f"'{name}' must be at least 1, not {_value(c, name)}")
    for name in ABOVE_ZERO:
        if not 0.0 < _value(c, name) < math.inf:
            raise ConfigError(f"'{name}' must be above 0, not {_value(c, name)}")
    for name in SHARES:
        if not 0.0 <= _value(c, name) <= 1.0:
            raise ConfigError(f"'{name}' must be 0 to 1, not {_value(c, name)}")
    if not 0 <= c.run.seed < 2**32:
        raise ConfigError(f"'run.seed' must be 0 to 4294967295, not {c.run.seed}")
    if not 1e-4 <= c.physics.timestep <= 0.02:
        raise ConfigError(f"'physics.timestep' must be 0.0001 to 0.02 s, not {c.physics.timestep}")
    _check_minibatches(c)
    _check_grids(c)
    _check_camera(c)


def _value(c: Config, name: str) -> int | float:
    part, _, field = name.partition(".")
    return getattr(getattr(c, part), field)


def _check_minibatches(c: Config) -> None:
    robots, parts = c.run.num_envs, c.ppo.minibatches
    if robots % parts:
        below, above = robots // parts * parts, -(-robots // parts) * parts
        near = f"{below} or {above}" if below else f"{above}"
        raise ConfigError(f"{robots} robots do not split into {parts} minibatches; take {near}")


def _check_grids(c: Config) -> None:
    """Refuse grids without samples."""
    grids = {
        "scan.x": c.scan.x, "scan.y": c.scan.y, "scan.ahead": c.scan.ahead,
        "foothold.quality_x": c.foothold.quality_x, "foothold.quality_y": c.foothold.quality_y,
    }  # fmt: skip
    for name, (low, high, count) in grids.items():
        if count < 1 or not low <= high:
            raise ConfigError(f"'{name}' must be from, to, samples, not {low} {high} {count}")


def _check_camera(c: Config) -> None:
    """Refuse images that the depth tokenizer's filters do not cover exactly."""
    if c.camera.window < 1 or c.camera.window % 2 == 0:
        raise ConfigError(f"'camera.window' must be 1, 3, 5, ..., not {c.camera.window}")
    if c.network.variant == "blind":
        return
    if c.network.token % c.network.heads:
        heads = f"{c.network.heads} heads"
        raise ConfigError(f"'network.token', {c.network.token}, does not split into {heads}")
    shrink = math.prod(stride for _, _, stride in c.network.convolutions)
    blocks = math.lcm(max(shrink, 1), COMPRESSION)
    if not c.network.convolutions or shrink < 1:
        raise ConfigError("'network.convolutions' must have a layer, of stride 1 or more")
    for size, what in zip(c.camera.shape, ("rows", "columns"), strict=True):
        if size < blocks or size % blocks:
            near = max(round(size / blocks), 1) * blocks
            raise ConfigError(
                f"'camera.shape': {size} {what} do not split into blocks of {blocks} x {blocks} "
                f"pixels; take {near}"
            )
