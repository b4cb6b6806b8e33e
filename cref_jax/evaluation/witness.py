"""What pictures need of the trials of an evaluation: a gait, touchdowns on stairs, failures.

It is taken from the very trials that are counted, so it costs no simulation.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cref_jax.env import footholds
from cref_jax.env.world import World
from cref_jax.evaluation import gait_pattern, touchdowns
from cref_jax.evaluation.recorder import STAIRS
from cref_jax.evaluation.touchdowns import Touchdowns
from cref_jax.evaluation.trials import Look, TrialSpecs, Walk
from cref_jax.physics.simulation import Physics
from cref_jax.robot import kinematics
from cref_jax.terrain import cross_section
from cref_jax.terrain.cross_section import Profile

MOST_TRIALS = 100  # per cell whose touchdowns are kept; assumed: thousands of touchdowns
TAIL = 4.0  # s of a failed trial that are kept; assumed: what led to the fall

Cell = Mapping[str, Any]  # kind, level and size_m


class Failure(NamedTuple):
    """The first failed trial of a cell."""

    cell: Cell
    failures: int  # in this cell
    number: int  # of the trial
    lane: tuple[int, int]  # kind and level in the world
    qpos: Float[np.ndarray, "T Q"]  # the last `TAIL` before its end
    ending: str
    seconds: float


class Witness:
    """Follows trials and keeps what the pictures need of them."""

    def __init__(self) -> None:
        """Begin without a trial."""
        self._world: World | None = None  # of the trials; worlds that it watches share their lanes
        self._failures: dict[int, Failure] = {}  # by cell
        self._gaits: dict[tuple[int, int], tuple[int, Walk]] = {}  # by kind and level
        self._landings: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = {}

    def watch(self, world: World, cells: Sequence[Cell | None], specs: TrialSpecs) -> Look:
        """Return the `look` of `trials.run` for cells of equally many trials; None is left out."""
        self._world = world
        count = len(specs.number) // len(cells)

        def look(trial: int, walk: Walk) -> None:
            place, cell = trial // count, cells[trial // count]
            if cell is None:
                return
            lane = int(specs.kind[trial]), int(specs.level[trial])
            number = int(specs.number[trial])
            if walk.ending != "finished":
                self._keep_failure(place, cell, number, lane, walk)
            if number <= self._gaits.get(lane, (number, walk))[0]:
                self._gaits[lane] = number, walk
            if number < MOST_TRIALS and world.lanes.kinds[lane[0]] in STAIRS:
                self._keep_landings(lane, walk)

        return look

    @property
    def world(self) -> World:
        """The world of the trials."""
        assert self._world is not None
        return self._world

    @property
    def _period(self) -> float:
        return self.world.config.physics.control_period

    def record(self) -> dict[str, Any]:
        """Build the parts of eval.json: `gait` and, where there were stairs, `touchdowns`."""
        found = {"gait": self._describe_gaits()}
        if self._landings:
            tread = touchdowns.tread_depth(self._stairs(next(iter(self._landings))))
            found["touchdowns"] = touchdowns.summarize(self._place_landings(), tread)
        return found

    def worst(self, most: int) -> list[Failure]:
        """Return the first failures of the cells with the most, most first."""
        return sorted(self._failures.values(), key=lambda f: -f.failures)[:most]

    def _keep_failure(
        self, place: int, cell: Cell, number: int, lane: tuple[int, int], walk: Walk
    ) -> None:
        before = self._failures.get(place)
        count = 1 + (before.failures if before else 0)
        if before and before.number < number:
            self._failures[place] = before._replace(failures=count)
            return
        qpos = walk.qpos[-round(TAIL / self._period) :].copy()
        seconds = len(walk.qpos) * self._period
        self._failures[place] = Failure(cell, count, number, lane, qpos, walk.ending, seconds)

    def _keep_landings(self, lane: tuple[int, int], walk: Walk) -> None:
        """Keep the pose after each touchdown; there is none after the last step of a trial."""
        steps, feet = touchdowns.find_touchdowns(walk.airborne[:-1], self._period)
        self._landings.setdefault(lane, []).append((walk.qpos[steps + 1], feet))

    def _place_landings(self) -> Touchdowns:
        """Locate the soles of all touchdowns that were kept on their treads."""
        of_lane = {lane: _join(parts) for lane, parts in sorted(self._landings.items())}
        soles = np.asarray(
            _soles(self.world.physics, np.concatenate([qpos for qpos, _ in of_lane.values()]))
        )
        found, done = [], 0
        for lane, (_, feet) in of_lane.items():
            sole = soles[np.arange(done, done + len(feet)), feet].astype(np.float64)
            done += len(feet)
            at = touchdowns.place(self._stairs(lane), sole[:, 0], sole[:, 2])
            on = at.flight != 0
            size = np.full(int(on.sum()), self._size(lane))
            found.append(Touchdowns(at.flight[on], size, feet[on], at.position[on]))
        return Touchdowns(*map(np.concatenate, zip(*found, strict=True)))

    def _stairs(self, lane: tuple[int, int]) -> Profile:
        kind, level = lane
        return cross_section.from_lane(self.world.lanes.tile(level, kind))

    def _size(self, lane: tuple[int, int]) -> float:
        kind, level = lane
        return round(float(self.world.lanes.sizes[level, kind]), 6)  # m

    def _describe_gaits(self) -> list[dict[str, Any]]:
        """Describe one walk per kind of lane, on obstacles of its middle size."""
        found = []
        for kind, name in enumerate(self.world.lanes.kinds):
            walks = {
                (self._size(lane), number): walk
                for lane, (number, walk) in self._gaits.items()
                if lane[0] == kind
            }
            if walks:
                sizes = sorted({size for size, _ in walks})
                middle = sizes[(len(sizes) - 1) // 2]
                first = min(key for key in walks if key[0] == middle)
                pattern = gait_pattern.describe(walks[first].airborne, self._period)
                found.append({"lane": name, "size_m": middle, **pattern})
        return found


def _join(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    qpos, feet = map(np.concatenate, zip(*parts, strict=True))
    return qpos, feet


def _soles(physics: Physics, qpos: Float[np.ndarray, "n Q"]) -> Float[Array, "n F 3"]:
    """Compute the centres of both soles in each pose, m."""

    @jax.jit
    def of(qpos: Float[Array, "n Q"]) -> Float[Array, "n F 3"]:
        still = jnp.zeros(qpos.shape[1] - 1)
        links = lambda q: kinematics.links(physics.tree, q, still)
        return jax.vmap(lambda q: footholds.soles(links(q), physics.robot).centre)(qpos)

    return of(qpos)
