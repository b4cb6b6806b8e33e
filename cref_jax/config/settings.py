"""Every number of the program, with its unit and its source.

A comment that names a table, a section or an equation points into the CReF paper; `assumed:` marks
what the paper does not say, so that `grep -rn "assumed:" cref_jax` is the complete list of choices.
Defaults are the paper's. A run changes them by a TOML file of differences or on the command line.
"""

from dataclasses import dataclass, field

from cref_jax.config.learning import PPO, Distillation, Network, Run
from cref_jax.config.simulation import Camera, Foothold, Physics, Robot, Scan, Terrain
from cref_jax.config.task import Command, Curriculum, Episode, Randomisation, Reward


@dataclass(frozen=True)
class Config:
    """All settings of a run."""

    run: Run = field(default_factory=Run)
    robot: Robot = field(default_factory=Robot)
    physics: Physics = field(default_factory=Physics)
    terrain: Terrain = field(default_factory=Terrain)
    curriculum: Curriculum = field(default_factory=Curriculum)
    command: Command = field(default_factory=Command)
    episode: Episode = field(default_factory=Episode)
    randomisation: Randomisation = field(default_factory=Randomisation)
    reward: Reward = field(default_factory=Reward)
    scan: Scan = field(default_factory=Scan)
    camera: Camera = field(default_factory=Camera)
    foothold: Foothold = field(default_factory=Foothold)
    network: Network = field(default_factory=Network)
    ppo: PPO = field(default_factory=PPO)
    distillation: Distillation = field(default_factory=Distillation)
