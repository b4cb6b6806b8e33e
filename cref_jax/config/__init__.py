"""Every number of the program, and how a run changes them."""

from cref_jax.config.learning import HPL, PPO, Distillation, Network, Run, Variant
from cref_jax.config.overrides import check_finite, describe_unknown, load_toml, override
from cref_jax.config.settings import Config
from cref_jax.config.simulation import (
    NARROW_VIEW,
    Camera,
    Foothold,
    Physics,
    Robot,
    Scan,
    Terrain,
)
from cref_jax.config.task import Command, Curriculum, Episode, Randomisation, Reward, RewardWeights
from cref_jax.errors import ConfigError

__all__ = [
    "HPL",
    "NARROW_VIEW",
    "PPO",
    "Camera",
    "Command",
    "Config",
    "ConfigError",
    "Curriculum",
    "Distillation",
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
    "check_finite",
    "describe_unknown",
    "load_toml",
    "override",
]
