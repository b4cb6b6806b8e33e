"""Teachers of a run by PPO: frozen policies, each imitated on lanes of its own kinds and levels.

The student acts, and each teacher says what it would do in the states that are visited on its lanes
(DAgger, Ross et al. 2011); how far the student is from that is one more loss of PPO (kickstarting,
arXiv 1803.03835). Lanes that no other teacher has are the first one's: the policy that the run
begins as. Robots for which nothing is randomised may have another, and lanes none at all.
"""

import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from cref_jax import config, network, ppo
from cref_jax.config.overrides import describe_unknown
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.ppo import gaussian
from cref_jax.terrain.atlas import Atlas
from cref_jax.training import randomization_ramp

UNDISTURBED = "undisturbed"  # in place of a kind: robots for which nothing is randomised
NOBODY = "none"  # in place of a policy: these robots learn by PPO alone
_UNSAID, _ALONE = -1, -2  # in place of a teacher's number


class Teacher(NamedTuple):
    """What a teacher's actions are computed with."""

    actor: PyTree
    obs: ppo.RunningStatistics


class Lesson(NamedTuple):
    """Lanes on which a policy is imitated."""

    kind: str  # or UNDISTURBED
    levels: tuple[int, int] | None  # first and last; None: all
    policy: str  # or NOBODY


def read_lessons(c: config.Distillation) -> list[Lesson]:
    """Read which lanes have which teacher.

    Raises:
        ConfigError: an entry that is not KIND=POLICY or KIND:FIRST-LAST=POLICY.
    """
    lessons = []
    for entry in c.teachers:
        found = re.fullmatch(r"([^=:]+)(?::(\d+)(?:-(\d+))?)?=(.+)", entry)
        if not found:
            raise ConfigError(
                f"--distillation.teachers: '{entry}' is not KIND=POLICY or KIND:FIRST-LAST=POLICY"
            )
        kind, first, last, policy = found.groups()
        levels = (int(first), int(last or first)) if first else None
        lessons.append(Lesson(kind, levels, policy))
    return lessons


def list_teachers(c: config.Distillation) -> list[str]:
    """List the teachers besides the policy that the run begins as, each once."""
    named = dict.fromkeys(lesson.policy for lesson in read_lessons(c))
    return [name for name in named if name != NOBODY]


def number_lanes(c: config.Config, lanes: Atlas) -> Int[np.ndarray, "2 kinds levels"]:
    """Number the teacher of each kind and level, for robots disturbed [0] and undisturbed [1].

    0 is the policy that the run begins as; below it, there is none.

    Raises:
        ConfigError: a kind or a level that the terrain does not have, a lane with two teachers, or
            one for robots that do not exist.
    """
    names = list_teachers(c.distillation)
    numbers = np.full((2, len(lanes.kinds), lanes.levels), _UNSAID)
    for kind, levels, policy in read_lessons(c.distillation):
        first, last = levels or (0, lanes.levels - 1)
        if not first <= last < lanes.levels:
            raise ConfigError(
                f"--distillation.teachers: '{kind}:{first}-{last}' must be levels that rise, of 0 "
                f"to {lanes.levels - 1}"
            )
        own = _find_kind(c, lanes, numbers, kind)[..., first : last + 1]
        if (own != _UNSAID).any():
            raise ConfigError(f"--distillation.teachers: two for a level of '{kind}'; give one")
        own[:] = _ALONE if policy == NOBODY else names.index(policy) + 1
    disturbed = np.where(numbers[0] == _UNSAID, 0, numbers[0])
    return np.stack([disturbed, np.where(numbers[1] == _UNSAID, disturbed, numbers[1])])


def _find_kind(
    c: config.Config, lanes: Atlas, numbers: Int[np.ndarray, "2 kinds levels"], kind: str
) -> Int[np.ndarray, "*kinds levels"]:
    """Find the part of the numbers that an entry of this kind is about."""
    if kind == UNDISTURBED:
        if not c.randomisation.undisturbed:
            raise ConfigError(
                f"--distillation.teachers: '{kind}' needs --randomisation.undisturbed above 0"
            )
        return numbers[1]
    if kind not in lanes.kinds:
        unknown = describe_unknown("kind of lane", kind, [*lanes.kinds, UNDISTURBED])
        raise ConfigError(f"--distillation.teachers: {unknown}")
    return numbers[0, lanes.kinds.index(kind)]


def number_robots(c: config.Config, lanes: Atlas, num_envs: int) -> Int[np.ndarray, "E levels"]:
    """Number the teacher of each robot of a device on each level."""
    robots = np.arange(num_envs)
    undisturbed = randomization_ramp.deal_parts(c.randomisation, lanes, num_envs).undisturbed
    return number_lanes(c, lanes)[undisturbed.astype(int), lanes.kind_of(robots)]


def ask_teachers(
    world: World,
    actor: network.Actor,
    teachers: tuple[Teacher, ...],
    memory: network.Carry,
    rollout: ppo.Rollout,
    level: Int[Array, "T E"],
) -> tuple[network.Carry, Float[Array, "T E J"], Float[Array, "T E"]]:
    """Compute what each robot's teacher would have done in a rollout on lanes of these levels.

    Returns the teachers' memory after it, their mean actions, and how far the policy's are from
    them (nats, at its deviations), both NaN where nobody teaches. The kinds of lane
    are dealt out by the robots' numbers, so that each teacher sees the robots on its own kinds
    alone. A robot comes to another level, and so to another teacher, only where an episode begins,
    with an empty memory.
    """
    clean = ppo.zero_invalid(rollout)
    numbers = number_robots(world.config, world.lanes, rollout.begins.shape[1])
    before, target = memory, jnp.full_like(clean.mean, jnp.nan)
    for number, teacher in enumerate(teachers):
        own = np.flatnonzero((numbers == number).any(axis=1))
        if not own.size:
            continue
        obs = ppo.normalize(teacher.obs, clean.obs[:, own])
        sight = jax.tree.map(lambda x, own=own: x[:, own], clean.sight)
        carry = jax.tree.map(lambda x, own=own: x[own], before)
        carry, said = actor.apply(teacher.actor, carry, obs, clean.begins[:, own], sight)
        asked = jnp.asarray(numbers)[own, level[:, own]][..., None] == number
        keep = lambda old, new, own=own, asked=asked[-1]: old.at[own].set(
            jnp.where(asked, new, old[own])
        )
        target = target.at[:, own].set(jnp.where(asked, said.mean, target[:, own]))
        memory = jax.tree.map(keep, memory, carry)
    return memory, target, gaussian.kl_of_means(target, clean.mean, rollout.log_std[0, 0])
