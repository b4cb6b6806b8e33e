"""Teachers of a run by PPO: frozen policies, each imitated on lanes of its own kinds.

The student acts, and each teacher says what it would do in the states that are visited on its lanes
(DAgger, Ross et al. 2011); how far the student is from that is one more loss of PPO (kickstarting,
arXiv 1803.03835). Lanes that no other teacher has are the first one's: the policy that the run
begins as.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from cref_jax import config, network, ppo
from cref_jax.config.overrides import describe_unknown
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.ppo import gaussian
from cref_jax.terrain.atlas import Atlas


class Teacher(NamedTuple):
    """What a teacher's actions are computed with."""

    actor: PyTree
    obs: ppo.RunningStatistics


def split_names(c: config.Distillation) -> dict[str, str]:
    """Read which kinds of lane have which teacher.

    Raises:
        ConfigError: an entry that is not KIND=POLICY, or a kind with two teachers.
    """
    by_kind: dict[str, str] = {}
    for entry in c.teachers:
        kind, equals, path = entry.partition("=")
        if not (kind and equals and path):
            raise ConfigError(f"--distillation.teachers: '{entry}' is not KIND=POLICY")
        if kind in by_kind:
            raise ConfigError(f"--distillation.teachers: two for '{kind}'; give one")
        by_kind[kind] = path
    return by_kind


def list_teachers(c: config.Distillation) -> list[str]:
    """List the teachers besides the policy that the run begins as, each once."""
    return list(dict.fromkeys(split_names(c).values()))


def number_kinds(c: config.Distillation, lanes: Atlas) -> Int[np.ndarray, " kinds"]:
    """Number the teacher of each kind of lane; 0 is the policy that the run begins as.

    Raises:
        ConfigError: a kind that the terrain does not have.
    """
    by_kind, names = split_names(c), list_teachers(c)
    for kind in by_kind:
        if kind not in lanes.kinds:
            unknown = describe_unknown("kind of lane", kind, list(lanes.kinds))
            raise ConfigError(f"--distillation.teachers: {unknown}")
    return np.array([names.index(by_kind[k]) + 1 if k in by_kind else 0 for k in lanes.kinds])


def ask_teachers(
    world: World,
    actor: network.Actor,
    teachers: tuple[Teacher, ...],
    memory: network.Carry,
    rollout: ppo.Rollout,
) -> tuple[network.Carry, Float[Array, "T E J"], Float[Array, "T E"]]:
    """Compute what each robot's teacher would have done in a rollout.

    Returns the teachers' memory after it, their mean actions, and how far the policy's are from
    them (nats, at its deviations). The kinds of lane are dealt out by the robots' numbers, so that
    each teacher sees the robots on its own lanes alone.
    """
    clean = ppo.zero_invalid(rollout)
    kinds = world.lanes.kind_of(np.arange(rollout.begins.shape[1]))
    teacher_of = number_kinds(world.config.distillation, world.lanes)[kinds]
    target = clean.mean
    for number, teacher in enumerate(teachers):
        own = np.flatnonzero(teacher_of == number)
        if not own.size:
            continue
        obs = ppo.normalize(teacher.obs, clean.obs[:, own])
        sight = jax.tree.map(lambda x, own=own: x[:, own], clean.sight)
        carry = jax.tree.map(lambda x, own=own: x[own], memory)
        carry, said = actor.apply(teacher.actor, carry, obs, clean.begins[:, own], sight)
        target = target.at[:, own].set(said.mean)
        memory = jax.tree.map(lambda x, new, own=own: x.at[own].set(new), memory, carry)
    return memory, target, gaussian.kl_of_means(target, clean.mean, rollout.log_std[0, 0])
