"""The evaluation protocol: commands, time limits, lanes, and settings switched off."""

import dataclasses

import jax

from cref_jax.config import Config, Randomisation

COMMANDS = (0.4, 0.8)  # m/s forward, Sec. III-A
SECONDS = 20.0  # per episode on flat ground; assumed
TRIAL_SECONDS = 40.0  # time limit of a trial on a lane, Sec. III-A
DEPTH_FAULTS = {
    "depth_noise": 0.01,  # m at 1 m; assumed: a D435i's data sheet allows 2 % at 2 m
    "depth_scale": 0.03,  # assumed, as the next three
    "depth_dead": 0.1,
    "depth_holes": 0.2,
    "narrow_view": 0.5,
}
"""Up to what a camera's images are wrong where everything is randomised"""
LANE_SEEDS = tuple(range(1001, 1006))  # of trial lanes; not used in training


def evaluation_config(c: Config, seconds: float = SECONDS) -> Config:
    """Build the evaluation settings: nothing randomised, forward commands, heading held."""
    return dataclasses.replace(
        c,
        randomisation=dataclasses.replace(c.randomisation, enabled=False),
        curriculum=dataclasses.replace(c.curriculum, enabled=False),
        command=dataclasses.replace(
            c.command,
            lane_vx=COMMANDS,
            lane_free=0.0,
            open_kinds=(),
            period=(2 * seconds, 2 * seconds),
        ),
        episode=dataclasses.replace(c.episode, length=seconds, stall_time=0.0, start_anywhere=0.0),
    )


def trial_config(c: Config) -> Config:
    """Build the settings of trials: those of evaluation, with training-only settings at defaults.

    Policies of one network thus share one compiled program.
    """
    base = Config()
    c = dataclasses.replace(c, run=base.run, ppo=base.ppo, curriculum=base.curriculum)
    c = dataclasses.replace(c, terrain=dataclasses.replace(c.terrain, name="flat"))
    return evaluation_config(c, TRIAL_SECONDS)


def randomise(c: Config) -> Config:
    """Switch the randomisation on, with ranges that are the same for all policies."""
    return dataclasses.replace(c, randomisation=Randomisation(**DEPTH_FAULTS))


def robots_per_block() -> int:
    """Return the number of robots per device in trials; assumed: fills it."""
    return 100 if jax.default_backend() == "cpu" else 1000
