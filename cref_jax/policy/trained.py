"""A trained policy, and its loading from a run."""

from pathlib import Path
from typing import NamedTuple

import jax

from cref_jax import ppo
from cref_jax.config import Config
from cref_jax.env.world import World
from cref_jax.training import iteration, run_dir


class TrainedPolicy(NamedTuple):
    """A trained policy and its origin."""

    config: Config
    train: ppo.TrainState
    iteration: int
    run: Path

    @property
    def samples(self) -> int:
        """Control steps of training experience."""
        return count_samples(self.config, self.iteration)


def count_samples(c: Config, iteration: int) -> int:
    """Count the control steps of training experience in this many iterations."""
    return iteration * c.run.num_envs * c.ppo.horizon


def load_policy(run: Path, world: World) -> TrainedPolicy:
    """Load the newest policy of a run; `world` may have another terrain than in training.

    Raises:
        ConfigError: the run does not exist.
        CheckpointError: it has no readable checkpoint.
    """
    like = jax.eval_shape(lambda w: iteration.initial_state(w).train, world)
    c = run_dir.read_config(run)
    with run_dir.checkpoints(run) as steps:
        newest = steps.latest()
        train = steps.restore_part("train", like, newest)
        return TrainedPolicy(c, with_averaged_actor(train), newest or 0, run)


def with_averaged_actor(train: ppo.TrainState) -> ppo.TrainState:
    """Replace the actor by its average: the policy that is evaluated and exported."""
    return train.replace(params=train.params._replace(actor=train.average))
