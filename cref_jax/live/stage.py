"""The ground to walk on, the robot on it and its starts: those of `sim2sim` and the scene suite."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cref_jax.config import Config
from cref_jax.env.world import World, build_physics, make_world
from cref_jax.errors import ConfigError
from cref_jax.evaluation import protocol, scene_suite, whole_robot
from cref_jax.live.policies import Loaded
from cref_jax.terrain import generators, heightmap, lanes
from cref_jax.whole_body import scene_files
from cref_jax.whole_body.ground import Ground
from cref_jax.whole_body.simulator import WholeBodySim
from cref_jax.whole_body.trial import Start

STARTS = 20  # before they repeat; assumed: enough that nobody notices


@dataclass(frozen=True)
class Place:
    """What to walk on: a scene, else a height map, else a lane of one kind and size."""

    kind: str = "flat"
    size: float = 0.0  # m; for a slope its gradient
    terrain: str = "flat"  # whose shape a lane has, where it defines the kind
    map: Path | None = None
    scene: str | None = None

    def title(self) -> str:
        """Name it in a few words."""
        if self.scene:
            return scene_files.load_named(self.scene).title
        if self.map:
            return self.map.name
        size = generators.format_size(self.kind, self.size)
        return self.kind.replace("_", " ") + (f", {size}" if self.size else "")


class Stage(NamedTuple):
    """All that an episode begins from."""

    place: Place
    policy: Loaded
    body: WholeBodySim
    starts: list[Start]  # of the trials on this ground, in their order

    @property
    def ground(self) -> Ground:
        """The ground that the robot walks on."""
        return self.body.ground


class StageBuilder:
    """Builds stages; what takes seconds, the world of the starts, is kept for each robot."""

    def __init__(self, seed: int) -> None:
        """`seed` is that of the starts, as in `sim2sim` and the scene suite."""
        self._seed = seed
        self._worlds: dict[Config, World] = {}

    def build(self, policy: Loaded, place: Place) -> Stage:
        """Build the ground and place the robot on it.

        Raises:
            ConfigError: there is no such ground, or it needs too many boxes.
        """
        return self._build_scene(policy, place) if place.scene else self._build_lane(policy, place)

    def _build_scene(self, policy: Loaded, place: Place) -> Stage:
        assert place.scene
        ground = scene_files.load_named(place.scene)
        c = protocol.evaluation_config(policy.config, protocol.TRIAL_SECONDS)
        body = WholeBodySim(c, ground, policy.runtime().joints.names)
        start: Callable[[int], Start] = lambda number: scene_suite.sample_start(
            body, ground.name, self._seed, number
        )
        return Stage(place, policy, body, [start(number) for number in range(STARTS)])

    def _build_lane(self, policy: Loaded, place: Place) -> Stage:
        """Build a lane: of those that trials alternate between, the first."""
        world = self._world(policy.config)
        c = world.config
        if place.map:
            atlas, turns = heightmap.read_map(place.map), 1
        else:
            if place.kind not in generators.KINDS:
                known = ", ".join(generators.KINDS)
                raise ConfigError(f"there is no kind of lane '{place.kind}'; take {known}")
            terrain = dataclasses.replace(c.terrain, name=place.terrain)
            atlas = lanes.build_grid(terrain, {place.kind: (place.size,)}, protocol.LANE_SEEDS)
            turns = len(protocol.LANE_SEEDS)
        world = world.replace(lanes=atlas)
        numbers = np.arange(STARTS) * turns
        starts = whole_robot.states_of_trials(
            world, self._seed, numbers, np.zeros(STARTS, np.int32)
        )
        body = WholeBodySim(c, whole_robot.to_lane(world), policy.runtime().joints.names)
        return Stage(place, policy, body, starts)

    def _world(self, c: Config) -> World:
        c = protocol.trial_config(c)
        if c not in self._worlds:
            physics = build_physics(c, "mujoco")
            self._worlds[c] = make_world(c, physics)
        return self._worlds[c]
