"""Every number of the program, and how a run changes them."""

from cref_jax.config.overrides import load_toml, override, unknown
from cref_jax.config.settings import (
    PPO,
    Camera,
    Command,
    Config,
    Curriculum,
    Episode,
    Foothold,
    Network,
    Physics,
    Randomisation,
    Reward,
    RewardWeights,
    Robot,
    Run,
    Scan,
    Terrain,
    Variant,
)
from cref_jax.errors import ConfigError

__all__ = [
    "PPO",
    "Camera",
    "Command",
    "Config",
    "ConfigError",
    "Curriculum",
    "Episode",
    "Foothold",
    "Network",
    "Physics",
    "Randomisation",
    "Reward",
    "RewardWeights",
    "Robot",
    "Run",
    "Scan",
    "Terrain",
    "Variant",
    "load_toml",
    "override",
    "unknown",
]
