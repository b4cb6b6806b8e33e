"""Success rate of a policy on lanes of one kind with obstacles of one size."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from cref_jax import ppo
from cref_jax.config import Config
from cref_jax.env.world import World, make_world
from cref_jax.evaluation import lateral_drift, protocol, trials
from cref_jax.evaluation.protocol import LANE_SEEDS
from cref_jax.evaluation.witness import Witness
from cref_jax.physics.simulation import Physics
from cref_jax.terrain import generators, lanes
from cref_jax.training import rollout


class LaneResult(NamedTuple):
    """Outcome of trials on lanes of one kind with obstacles of one size."""

    kind: str
    size_m: float  # the gradient of a slope
    trials: int
    successes: int  # reached the lane's end in time
    by_cause: dict[str, int]  # of the failures
    seconds: float | None  # mean time of a success, None without any
    speed: float  # m/s forward, mean over the trials
    sideways: dict[str, float] | None = None
    """m, see lateral_drift.summarize; None in the whole-robot simulator"""

    def line(self) -> str:
        """Format the outcome as one line."""
        causes = ", ".join(f"{n} {cause}" for cause, n in self.by_cause.items() if n)
        return (
            f"{self.kind} {generators.format_size(self.kind, self.size_m)}: {self.successes} of "
            f"{self.trials} trials crossed, "
            + ("" if self.seconds is None else f"{self.seconds:.1f} s each, ")
            + f"{self.speed:.2f} m/s"
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
    on_finished: Callable[[int], None] = lambda count: None,
    randomised: bool = False,
    witness: Witness | None = None,
) -> LaneResult:
    """Run trials of the policy's mean action on lanes with these obstacles."""
    world = crossing_world(c, physics, kind, size)
    if randomised:
        world = world.replace(config=protocol.randomise(world.config))
    specs = trials.TrialSpecs(np.arange(count), *crossing_lanes(count))
    cell = {"kind": kind, "size_m": size}
    look = witness.watch(world, [cell], specs) if witness else trials.LOOK_AWAY
    step_fn, block = trials.make_step_fn(train), protocol.robots_per_block()
    outcomes = trials.run(world, step_fn, specs, seed, block, on_finished, look)
    succeeded = outcomes.succeeded
    return LaneResult(
        kind=kind,
        size_m=size,
        trials=count,
        successes=int(succeeded.sum()),
        by_cause=outcomes.failures(),
        seconds=float(outcomes.seconds[succeeded].mean()) if succeeded.any() else None,
        speed=float(outcomes.forward.mean()),
        sideways=lateral_drift.summarize(outcomes.drift, outcomes.aside),
    )


def crossing_world(c: Config, physics: Physics, kind: str, size: float) -> World:
    """Build the world of trials on lanes of one kind with obstacles of one size, m."""
    atlas = lanes.build_grid(c.terrain, {kind: (size,)}, LANE_SEEDS)
    return make_world(protocol.trial_config(c), physics).replace(lanes=atlas)


def crossing_lanes(count: int) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Return kind and level of each trial's lane in `crossing_world`, round-robin."""
    return np.zeros(count, np.int32), np.arange(count, dtype=np.int32) % len(LANE_SEEDS)


def first_robots(world: World, seed: int, count: int) -> rollout.Robots:
    """Place robots at the start of this seed's first trials in `crossing_world`."""
    return trials.start_robots(world, seed, np.arange(count), *crossing_lanes(count))
