"""How often a policy crosses lanes of one kind with obstacles of one size."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from cref_jax import ppo
from cref_jax.config import Config
from cref_jax.env.world import World, make_world
from cref_jax.evaluation import lateral_drift, protocol, trials
from cref_jax.evaluation.protocol import LANE_SEEDS
from cref_jax.physics.simulation import Physics
from cref_jax.terrain import generators, lanes
from cref_jax.training import rollout


class Crossing(NamedTuple):
    """The outcome of trials on lanes of one kind with obstacles of one size."""

    kind: str
    size_m: float  # of a slope its gradient
    trials: int
    successes: int  # came to the lane's end in time
    by_cause: dict[str, int]  # of the failures
    seconds: float  # mean time of a success
    speed: float  # m/s forward, mean over the trials
    sideways: dict[str, float] | None = (
        None  # m, see lateral_drift.summarize; None for a robot in another simulation
    )

    def line(self) -> str:
        """Return the outcome in one line for people."""
        causes = ", ".join(f"{n} {cause}" for cause, n in self.by_cause.items() if n)
        return (
            f"{self.kind} {generators.extent(self.kind, self.size_m)}: {self.successes} of "
            f"{self.trials} trials crossed, {self.seconds:.1f} s each, {self.speed:.2f} m/s"
            + (f"; failures: {causes}" if causes else "")
        )


def cross(
    c: Config,
    physics: Physics,
    train: ppo.TrainState,
    kind: str,
    size: float,
    count: int = 200,
    seed: int = 0,
    ended: Callable[[int], None] = lambda count: None,
) -> Crossing:
    """Return how often the policy's mean action comes to the end of lanes with such obstacles."""
    world = crossing_world(c, physics, kind, size)
    asked = trials.Asked(np.arange(count), *crossing_lanes(count))
    made = trials.run(world, trials.follow(train), asked, seed, protocol.robots_per_block(), ended)
    done = made.succeeded
    return Crossing(
        kind=kind,
        size_m=size,
        trials=count,
        successes=int(done.sum()),
        by_cause=made.failures(),
        seconds=float(made.seconds[done].mean()) if done.any() else float("nan"),
        speed=float(made.forward.mean()),
        sideways=lateral_drift.summarize(made.drift, made.aside),
    )


def crossing_world(c: Config, physics: Physics, kind: str, size: float) -> World:
    """Return the world of trials on lanes of one kind with obstacles of one size, m."""
    atlas = lanes.grid(c.terrain, {kind: (size,)}, LANE_SEEDS)
    return make_world(protocol.trial_config(c), physics).replace(lanes=atlas)


def crossing_lanes(count: int) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Return kind and level of the lanes of so many trials in `crossing_world`: each in turn."""
    return np.zeros(count, np.int32), np.arange(count, dtype=np.int32) % len(LANE_SEEDS)


def first_robots(world: World, seed: int, count: int) -> rollout.Robots:
    """Return the robots as the trials of this seed begin in `crossing_world`."""
    return trials.begin(world, seed, np.arange(count), *crossing_lanes(count))
