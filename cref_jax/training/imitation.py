"""Teachers of a run by PPO: frozen policies, each imitated on lanes of its own kinds and levels.

The student acts, and each teacher says what it would do in the states that are visited on its lanes
(DAgger, Ross et al. 2011); how far the student is from that is one more loss of PPO (kickstarting,
arXiv 1803.03835). Lanes that no other teacher has are the first one's: the policy that the run
begins as. Robots for which nothing is randomised may have another, and lanes none at all. Robots
that are only pushed have that other one as well, but not in the second after a push: until it
comes, nothing tells them from robots that are left alone.
"""

import functools
import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from cref_jax import config, network, ppo
from cref_jax.config.overrides import describe_unknown
from cref_jax.env.environment import Measures
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.ppo import gaussian
from cref_jax.terrain.atlas import Atlas
from cref_jax.training import randomization_ramp
from cref_jax.training.rollout import Robots

UNDISTURBED = "undisturbed"  # before a kind, or in its place: robots with nothing randomised
NOBODY = "none"  # in place of a policy: these robots learn by PPO alone
AFTER_PUSH = 1.0
"""s for which a robot that is only pushed has the disturbed robots' teacher: a policy that hands
over to `robust` for longer after a push falls as often"""
_UNSAID, _ALONE = -1, -2  # in place of a teacher's number
_LONG_AGO = 2**20  # control steps since a push that never was


class Teacher(NamedTuple):
    """What a teacher's actions are computed with."""

    actor: PyTree
    obs: ppo.RunningStatistics


class TeacherMemory(NamedTuple):
    """What the teachers of E robots remember between two rollouts."""

    disturbed: network.Carry
    undisturbed: network.Carry
    since_push: Int[Array, " E"]  # control steps since the last push of the episode


class Lesson(NamedTuple):
    """Lanes on which a policy is imitated."""

    who: str  # a kind, UNDISTURBED, or UNDISTURBED/kind
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
    numbers = np.full((3, len(lanes.kinds), lanes.levels), _UNSAID)  # [2]: undisturbed, any kind
    for who, levels, policy in read_lessons(c.distillation):
        first, last = levels or (0, lanes.levels - 1)
        if not first <= last < lanes.levels:
            raise ConfigError(
                f"--distillation.teachers: '{who}:{first}-{last}' must be levels that rise, of 0 "
                f"to {lanes.levels - 1}"
            )
        own = _find_lanes(c, lanes, numbers, who)[..., first : last + 1]
        if (own != _UNSAID).any():
            raise ConfigError(f"--distillation.teachers: two for a level of '{who}'; give one")
        own[:] = _ALONE if policy == NOBODY else names.index(policy) + 1
    otherwise = lambda said, rest: np.where(said == _UNSAID, rest, said)
    disturbed = otherwise(numbers[0], 0)
    return np.stack([disturbed, otherwise(otherwise(numbers[1], numbers[2]), disturbed)])


def _find_lanes(
    c: config.Config, lanes: Atlas, numbers: Int[np.ndarray, "3 kinds levels"], who: str
) -> Int[np.ndarray, "*kinds levels"]:
    """Find the part of the numbers that an entry is about."""
    group, _, kind = who.rpartition("/")
    is_known = kind in lanes.kinds and group in ("", UNDISTURBED)
    if who != UNDISTURBED and not is_known:
        unknown = describe_unknown("kind of lane", who, [*lanes.kinds, UNDISTURBED])
        raise ConfigError(f"--distillation.teachers: {unknown}")
    has_undisturbed = c.randomisation.undisturbed > 0.0 or c.randomisation.pushed_alone > 0.0
    if UNDISTURBED in (who, group) and not has_undisturbed:
        raise ConfigError(
            f"--distillation.teachers: '{who}' needs --randomisation.undisturbed or "
            "--randomisation.pushed-alone above 0"
        )
    if who == UNDISTURBED:
        return numbers[2]
    return numbers[int(group == UNDISTURBED), lanes.kinds.index(kind)]


def number_robots(c: config.Config, lanes: Atlas, num_envs: int) -> Int[np.ndarray, "2 E levels"]:
    """Number the two teachers of each robot of a device on each level, as `number_lanes` does.

    Below 0 where there is none: undisturbed robots never have the disturbed ones' teacher, and of
    the others those that are only pushed have both.
    """
    parts = randomization_ramp.deal_parts(c.randomisation, lanes, num_envs)
    numbers = number_lanes(c, lanes)[:, lanes.kind_of(np.arange(num_envs))]
    numbers[0, parts.undisturbed] = _ALONE
    numbers[1, ~(parts.undisturbed | parts.pushed_alone)] = _ALONE
    return numbers


def with_teachers(robots: Robots, c: config.Distillation) -> Robots:
    """Add an empty memory of the teachers, which is like the student's, and what they see."""
    blank = lambda: jax.tree.map(jnp.zeros_like, robots.memory.carry)
    since = jnp.full(robots.begins.shape, _LONG_AGO)
    memory = TeacherMemory(blank(), blank(), since)
    feed = robots.feed
    if feed is not None and c.true_senses:
        feed = feed.replace(clear=jnp.zeros_like(feed.frame))
    return robots.replace(memory=robots.memory._replace(teacher=memory), feed=feed)


def ask_teachers(
    world: World,
    actor: network.Actor,
    teachers: tuple[Teacher, ...],
    memory: TeacherMemory,
    rollout: ppo.Rollout,
    measures: Measures,
) -> tuple[TeacherMemory, Float[Array, "T E J"], Float[Array, "T E"]]:
    """Compute what each robot's teacher would have done in a rollout, measured in each step.

    Returns the teachers' memory after it, their mean actions, and how far the policy's are from
    them (nats, at its deviations), both NaN where nobody teaches.
    """
    c, num_envs = world.config, rollout.begins.shape[1]
    clean = ppo.zero_invalid(rollout)
    if c.distillation.true_senses:
        obs = clean.critic_obs[..., : clean.obs.shape[-1]]  # s_t begins with o^p_t without noise
        clean = clean._replace(obs=obs, sight=clean.guide)
    numbers = number_robots(c, world.lanes, num_envs)
    ask = functools.partial(_ask_group, actor, teachers, rollout=clean, level=measures.level)
    disturbed, target = ask(numbers[0], memory.disturbed)
    undisturbed, target_undisturbed = ask(numbers[1], memory.undisturbed)
    since, before = _count_since_push(memory.since_push, rollout.begins, measures.pushed)
    parts = randomization_ramp.deal_parts(c.randomisation, world.lanes, num_envs)
    is_recent = before < round(AFTER_PUSH / c.physics.control_period)
    is_undisturbed = parts.undisturbed | (parts.pushed_alone & ~is_recent)
    target = jnp.where(is_undisturbed[..., None], target_undisturbed, target)
    apart = gaussian.kl_of_means(target, clean.mean, rollout.log_std[0, 0])
    return TeacherMemory(disturbed, undisturbed, since), target, apart


def _count_since_push(
    since: Int[Array, " E"], begins: Bool[Array, "T E"], pushed: Bool[Array, "T E"]
) -> tuple[Int[Array, " E"], Int[Array, "T E"]]:
    """Count control steps since the last push of the episode: after a rollout, before each step.

    The push of a step comes after what is observed before it.
    """

    def count(since: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        begins, pushed = step
        before = jnp.where(begins, _LONG_AGO, since)
        return jnp.where(pushed, 0, before + 1), before

    return jax.lax.scan(count, since, (begins, pushed))


def _ask_group(
    actor: network.Actor,
    teachers: tuple[Teacher, ...],
    numbers: Int[np.ndarray, "E levels"],
    memory: network.Carry,
    rollout: ppo.Rollout,
    level: Int[Array, "T E"],
) -> tuple[network.Carry, Float[Array, "T E J"]]:
    """Compute what the teachers with these numbers remember, and their mean actions; NaN: none.

    The kinds of lane are dealt out by the robots' numbers, so that each teacher sees the robots on
    its own kinds alone. A robot comes to another level, and so to another teacher, only where an
    episode begins, with an empty memory.
    """
    before, target = memory, jnp.full_like(rollout.mean, jnp.nan)
    for number, teacher in enumerate(teachers):
        own = np.flatnonzero((numbers == number).any(axis=1))
        if not own.size:
            continue
        obs = ppo.normalize(teacher.obs, rollout.obs[:, own])
        sight = jax.tree.map(lambda x, own=own: x[:, own], rollout.sight)
        carry = jax.tree.map(lambda x, own=own: x[own], before)
        carry, said = actor.apply(teacher.actor, carry, obs, rollout.begins[:, own], sight)
        asked = jnp.asarray(numbers)[own, level[:, own]][..., None] == number
        keep = lambda old, new, own=own, asked=asked[-1]: old.at[own].set(
            jnp.where(asked, new, old[own])
        )
        target = target.at[:, own].set(jnp.where(asked, said.mean, target[:, own]))
        memory = jax.tree.map(keep, memory, carry)
    return memory, target
