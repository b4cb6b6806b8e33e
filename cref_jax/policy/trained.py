"""A trained policy, and its loading from a run."""

from pathlib import Path
from typing import NamedTuple

import jax

from cref_jax import ppo
from cref_jax.config import Config, override
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.training import distillation, iteration, run_dir


class TrainedPolicy(NamedTuple):
    """A trained policy and its origin."""

    config: Config
    train: ppo.TrainState
    iteration: int
    run: Path
    samples: int  # control steps of training experience


def count_samples(c: Config, iteration: int) -> int:
    """Count the control steps of this many iterations, all with the robots of these settings."""
    return iteration * c.run.num_envs * c.ppo.horizon


def describe_samples(c: Config, iteration: int, samples: int) -> str:
    """Say how many samples were seen, and by which stage of a run that has several."""
    text = f"{samples / 1e6:.1f} M samples"
    stages = distillation.samples_by_stage(c, iteration)
    each = ", ".join(f"{count / 1e6:.1f} M by the {name}" for name, count in stages.items())
    return f"{text} ({each})" if each else text


def load_policy(run: Path, world: World) -> TrainedPolicy:
    """Load the newest policy of a run; `world` may have another terrain than in training.

    Raises:
        ConfigError: the run does not exist, or trains the teacher of its policy still.
        CheckpointError: it has no readable checkpoint.
    """
    c = run_dir.read_config(run)
    like = learner_shapes(c, world)
    with run_dir.checkpoints(run) as steps:
        newest = steps.latest()
        stages = distillation.samples_by_stage(c, newest or 0)
        if newest and stages and not stages["student"]:
            last = distillation.teacher_config(c).run.iterations
            raise ConfigError(
                f"{run} has no student yet, its teacher {newest} of {last} iterations; go on with "
                "--resume"
            )
        train = steps.restore_part("train", like, newest)
        samples = run_dir.count_samples(run, c, newest or 0)
        return TrainedPolicy(c, with_averaged_actor(train), newest or 0, run, samples)


def learner_shapes(c: Config, world: World) -> ppo.TrainState:
    """Describe what a run with the settings `c` has learned: its shapes and dtypes.

    Only the actor is the world's, since another actor's parameters are of no use in it.
    """
    critic = {"critic": c.network.critic, "critic_sees": c.network.critic_sees}
    readout = {"readout_weight": c.ppo.readout_weight}
    scan = {"x": c.scan.x, "y": c.scan.y, "ahead": c.scan.ahead}
    changes = {"network": critic, "ppo": readout, "scan": scan}
    as_trained = world.replace(config=override(world.config, changes))
    return jax.eval_shape(lambda w: iteration.initial_state(w).train, as_trained)


def with_averaged_actor(train: ppo.TrainState) -> ppo.TrainState:
    """Replace the actor by its average: the policy that is evaluated and exported."""
    return train.replace(params=train.params._replace(actor=train.average))
