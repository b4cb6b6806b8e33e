"""Start of a new training from a trained policy, and with teachers."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp

from cref_jax import ppo
from cref_jax.config import HPL, Config
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.policy import learner_file, sources
from cref_jax.policy.trained import TrainedPolicy
from cref_jax.training import imitation
from cref_jax.training.imitation import Teacher
from cref_jax.training.iteration import RunState

CRITIC_FIRST = 200  # iterations after --init without a critic; after 20 its errors made robots fall
NOT_OF_THE_ACTOR = ("critic", "critic_sees", "initial_std", "min_std")  # of a network's settings


def adapt_settings(c: Config, init: Path) -> Config:
    """Adapt the settings to a run that begins as `init`.

    Raises:
        ConfigError: it has another network, or is of another robot.
    """
    if c.network.variant == "hpl":
        raise ConfigError("--init: a run of --network.variant hpl begins with a teacher of its own")
    _check_network(c, init, "--init")
    first = c.ppo.critic_first or (0 if has_critic(init, c) else CRITIC_FIRST)
    return dataclasses.replace(c, ppo=dataclasses.replace(c.ppo, critic_first=first))


def check_teachers(c: Config, init: Path | None, resumes: bool) -> None:
    """Refuse teachers that no loss follows, a loss without a teacher, and other networks.

    Raises:
        ConfigError: says which setting, and what would be right.
    """
    names = imitation.list_teachers(c.distillation)
    if not c.ppo.imitation_weight:
        if names:
            raise ConfigError("--distillation.teachers: --ppo.imitation-weight must be above 0")
        if c.distillation.true_senses:
            raise ConfigError("--distillation.true-senses: --ppo.imitation-weight must be above 0")
        return
    if c.network.variant in HPL:
        raise ConfigError(
            f"--ppo.imitation-weight must be 0 with --network.variant {c.network.variant}"
        )
    if resumes:  # the checkpoint has them
        return
    if init is None:
        raise ConfigError("--ppo.imitation-weight: say --init POLICY, the teacher on other lanes")
    for name in names:
        _check_network(c, sources.find_policy(Path(name)), "--distillation.teachers")


def _check_network(c: Config, path: Path, option: str) -> None:
    sources.check_robot(path, c.robot.name)
    theirs, ours = sources.read_config(path).network, c.network
    for name, value in dataclasses.asdict(theirs).items():
        if name not in NOT_OF_THE_ACTOR and value != getattr(ours, name):
            raise ConfigError(
                f"{option} {path} has another network: {name} is {value}, and here "
                f"{getattr(ours, name)}; set --network.{name.replace('_', '-')}"
            )


def has_critic(init: Path, c: Config) -> bool:
    """Return whether `init` holds everything that is trained, not the actor alone."""
    theirs = sources.read_config(init)
    read_out = theirs.ppo.readout_weight > 0.0, c.ppo.readout_weight > 0.0
    whole = sources.is_run(init) or learner_file.is_learner(init)
    return whole and theirs.network == c.network and read_out[0] == read_out[1]


def start(fresh: RunState, init: Path, world: World) -> tuple[ppo.TrainState, tuple[Teacher, ...]]:
    """Load what a training begins with: the learner, and its teachers if it has any.

    Raises:
        ConfigError: a policy that is none.
        CheckpointError: a run without a readable checkpoint.
    """
    policy = sources.load(init, world)
    taught: tuple[Teacher, ...] = ()
    if fresh.teachers:
        names = imitation.list_teachers(world.config.distillation)
        others = [sources.load(sources.find_policy(Path(name)), world) for name in names]
        taught = tuple(_as_teacher(x) for x in [policy, *others])
    if has_critic(init, world.config):
        average = jax.tree.map(jnp.copy, policy.train.average)  # the actor gives its own away
        learned = policy.train.replace(average=average, iteration=fresh.train.iteration)
        return learned, taught
    return start_from_policy(fresh.train, policy), taught


def _as_teacher(policy: TrainedPolicy) -> Teacher:
    """Copy what its actions are computed with: a program overwrites what it is given."""
    copied = jax.tree.map(jnp.copy, (policy.train.params.actor, policy.train.statistics.obs))
    return Teacher(*copied)


def start_from_policy(fresh: ppo.TrainState, policy: TrainedPolicy) -> ppo.TrainState:
    """Start a new training from the policy's actor and observation statistics."""
    trained, obs = policy.train.statistics.obs, fresh.statistics.obs
    variance = jnp.maximum(jnp.square(trained.std) - obs.std_eps, 0.0)
    statistics = obs.replace(
        mean=trained.mean,
        std=trained.std,
        summed_variance=float(policy.samples) * variance,  # int32 holds too few
        count=obs.count + policy.samples,
    )
    return fresh.replace(
        params=fresh.params._replace(actor=policy.train.params.actor),
        statistics=fresh.statistics._replace(obs=statistics),
    )
