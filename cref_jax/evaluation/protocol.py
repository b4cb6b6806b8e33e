"""The rules of evaluation: commands, times, lanes, and what is switched off."""

import dataclasses

import jax

from cref_jax.config import Config

COMMANDS = (0.4, 0.8)  # m/s forward, Sec. III-A
SECONDS = 20.0  # of an episode on flat ground; assumed
TRIAL_SECONDS = 40.0  # at most, of a trial on a lane, Sec. III-A
LANE_SEEDS = tuple(range(1001, 1006))  # of the lanes of trials: others than those of training


def evaluation_config(c: Config, seconds: float = SECONDS) -> Config:
    """Return the configuration to judge in: nothing randomised, forward commands, heading held."""
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
    """Return the configuration of trials: that of evaluation, without what training alone needs.

    So policies of one network share one compiled program.
    """
    base = Config()
    c = dataclasses.replace(c, run=base.run, ppo=base.ppo, curriculum=base.curriculum)
    c = dataclasses.replace(c, terrain=dataclasses.replace(c.terrain, name="flat"))
    return evaluation_config(c, TRIAL_SECONDS)


def robots_per_block() -> int:
    """Return how many robots a device steps together in trials; assumed: fills it."""
    return 100 if jax.default_backend() == "cpu" else 1000
