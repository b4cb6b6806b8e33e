"""Statistics of the highway gate by terrain, contact phase and posture (Sec. III-B).

The gate is beta of Eq. 16, mean over channels: near 1 the action relies on memory, near 0 on the
current observation. Robots walk lanes of every kind at their medium size with one command. The
first second, when the memory fills, and all steps after a robot's first episode do not count.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

from cref_jax import ppo
from cref_jax.config import Config
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.evaluation import recorder
from cref_jax.evaluation.recorder import Moment, StepRecords

COMMAND = 0.6  # m/s; assumed: the paper fixes the command and does not say at what
SECONDS = 20.0  # of a trial; assumed
GATELESS = ("no_highway", "hpl", "hpl_teacher")  # variants
RULE = (
    "The highway gate (Eq. 16), mean over channels, of robots on lanes of every kind at medium "
    f"size, {COMMAND:g} m/s forward for {SECONDS:g} s, without the first second. Near 1 the action "
    "relies on memory. Steps of 20 ms over all robots are far from independent."
)
RISKY = 0.20  # rad, |roll| or |pitch| above it, Sec. III-B
WARM_UP = 1.0  # s; assumed: the memory is empty at first and the robot stands
FEW = 100  # steps; smaller groups are marked
GROUPS = {
    "terrain": ("flat", "stairs up", "stairs down", "gap", "platform", "rough", "slope"),
    "phase": ("flight", "single support", "double support"),
    "posture": ("stable", "risky"),
}


class Step(NamedTuple):
    """Data recorded per control step of E robots; the state is that before the step."""

    gate: Float[Array, "E 3"]  # over channels: mean, 10th and 90th percentile
    airborne: Bool[Array, "E F"]
    pose: Float[Array, "E 7"]  # of the base: m, quaternion


class Row(NamedTuple):
    """Statistics of the gate in one state."""

    group: str
    state: str
    n: int  # steps over all robots
    robots: int
    mean: float
    q25: float
    median: float
    q75: float

    @property
    def note(self) -> str:
        """A warning for small groups."""
        return f"n below {FEW}" if self.n < FEW else ""


def check_variant(c: Config) -> None:
    """Check that the policy has a gate.

    Raises:
        ConfigError: it has none.
    """
    if c.network.variant in GATELESS:
        raise ConfigError(
            f"this policy has no gate: its variant is '{c.network.variant}'; use another"
        )


def measure(
    c: Config, world: World, train: ppo.TrainState, count: int, seed: int
) -> list[dict[str, Any]]:
    """Measure the gate of `count` robots: a record per state, with None where it has no step.

    Raises:
        ConfigError: the policy has no gate.
    """
    check_variant(c)
    world = recorder.make_trial_world(c, world, recorder.medium_lanes(c), COMMAND)
    robots = recorder.start_robots(world, seed, count)
    steps = recorder.count_steps(SECONDS, c)
    rows = make_rows(world, recorder.record(world, train, robots, steps, record_step))
    none = dict.fromkeys(("mean", "q25", "median", "q75"))
    return [row._asdict() | ({} if row.n else none) for row in rows]


def record_step(world: World, moment: Moment) -> Step:
    """Record the gate and the state for which it was computed."""
    state, gate = moment.robots.env, moment.policy.gate[0]
    low, high = jnp.percentile(gate, jnp.array([10.0, 90.0]), axis=1)
    return Step(
        gate=jnp.stack([gate.mean(axis=1), low, high], axis=1),
        airborne=~state.gait.down,
        pose=state.body.qpos[:, :7],
    )


def make_rows(world: World, watched: StepRecords) -> Iterator[Row]:
    """Yield the gate statistics of each state of each group."""
    seen = watched.seen
    counted = watched.alive.copy()
    counted[: round(WARM_UP / world.config.physics.control_period)] = False
    states = {
        "terrain": recorder.terrain_under(world.lanes, seen.pose[..., 0]),
        "phase": contact_phases(seen.airborne),
        "posture": postures(seen.pose[..., 3:]),
    }
    for group, names in GROUPS.items():
        for name in names:
            yield summarize_state(group, name, seen.gate[..., 0], counted & (states[group] == name))


def summarize_state(
    group: str, state: str, gate: Float[np.ndarray, "T E"], where: Bool[np.ndarray, "T E"]
) -> Row:
    """Summarise the gate over the steps of one state; NaN without steps."""
    x = gate[where].astype(np.float64)
    quartiles = np.percentile(x, (25, 50, 75)) if x.size else np.full(3, np.nan)
    mean = float(x.mean()) if x.size else float("nan")
    return Row(group, state, x.size, int(where.any(axis=0).sum()), mean, *map(float, quartiles))


def contact_phases(airborne: Bool[np.ndarray, "*n F"]) -> Shaped[np.ndarray, "*n"]:
    """Name the contact phase: double support, single support or flight."""
    return np.array(["double support", "single support", "flight"])[airborne.sum(axis=-1)]


def postures(rotation: Float[np.ndarray, "*n 4"]) -> Shaped[np.ndarray, "*n"]:
    """Name the posture: risky if |roll| or |pitch| of the base is above RISKY, else stable."""
    w, x, y, z = np.moveaxis(rotation, -1, 0)
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0))
    return np.where((np.abs(roll) > RISKY) | (np.abs(pitch) > RISKY), "risky", "stable")
