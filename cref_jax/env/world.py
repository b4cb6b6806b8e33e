"""What all environments share: settings, physics, lanes and a bank of initial states."""

from pathlib import Path
from typing import no_type_check

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from cref_jax import robot as robots
from cref_jax import terrain
from cref_jax.config import Config, Randomisation, describe_unknown
from cref_jax.errors import ConfigError
from cref_jax.physics.records import Body, EngineName
from cref_jax.physics.simulation import Physics, resolve_engine
from cref_jax.terrain import lanes, map_files
from cref_jax.terrain.atlas import Atlas
from cref_jax.terrain.generators import KINDS, START


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@flax.struct.dataclass
class World:
    """What all environments share; arrays are arguments of programs, not constants in them."""

    config: Config = flax.struct.field(pytree_node=False)
    physics: Physics = flax.struct.field(pytree_node=False)
    lanes: Atlas
    bank: Body  # settled states to start from, a leading axis of their number


def make_world(c: Config, physics: Physics) -> World:
    """Build the terrain and settle the states that episodes start from.

    Raises:
        ConfigError: the terrain is unknown, or its numbers, those of the starts or the robot's
            payload cannot be used.
    """
    c, atlas = robots.fill_in(c), lanes.build(c.terrain)
    _check_payload(c.randomisation, physics)
    _check_lanes(c, atlas)
    return World(c, physics, atlas, _settle_robots(c, physics))


def _check_payload(c: Randomisation, physics: Physics) -> None:
    """Refuse payloads of which a negative one would leave nothing of the trunk."""
    trunk = float(physics.model.body_mass[physics.robot.trunk])
    if c.enabled and c.trunk_mass >= trunk:
        raise ConfigError(
            f"--randomisation.trunk-mass must be below {trunk:.3g} kg, what the robot's trunk "
            f"weighs, not {c.trunk_mass:g}"
        )


def _check_lanes(c: Config, atlas: Atlas) -> None:
    """Refuse kinds of lanes that there are none of, and starts beyond a lane's goal."""
    known = [*KINDS, *atlas.kinds]
    for kind in c.command.open_kinds:
        if kind not in known:
            raise ConfigError(f"--command.open-kinds: {describe_unknown('kind', kind, known)}")
    on_lanes = bool(set(atlas.kinds) - set(c.command.open_kinds))
    if on_lanes and not map_files.is_map(c.terrain.name) and c.episode.start_x[1] > START:
        raise ConfigError(
            f"--episode.start-x is up to {c.episode.start_x[1]:g} m along the lane, and obstacles "
            f"may begin at {START:g} m"
        )
    goal = float(atlas.end) - c.episode.lane_end
    if not on_lanes or c.episode.start_x[1] < goal:
        return
    if map_files.is_map(c.terrain.name):
        toml = Path(c.terrain.name).with_suffix(".toml").name
        raise ConfigError(
            f"{toml}: start is too near the map's end: the robot would begin up to "
            f"{c.episode.start_x[1] - goal:.2g} m past its goal, --episode.lane-end, "
            f"{c.episode.lane_end:g} m, before the end"
        )
    raise ConfigError(
        f"--episode.start-x is up to {c.episode.start_x[1]:g} m along the lane, and its goal, "
        f"--episode.lane-end before its end, is at {goal:g} m"
    )


def _settle_robots(c: Config, physics: Physics) -> Body:
    """Simulate `bank_size` robots standing on flat ground for `settle_time`."""
    flat = terrain.from_heights(jnp.zeros((1, 1)), c.terrain.cell, (0.0, 0.0))
    robot, nominal = physics.robot, physics.nominal_dynamics()
    steps = round(c.episode.settle_time / c.physics.control_period)
    target, rest = jnp.asarray(robot.nominal_pose), jnp.asarray(robot.rest_pose)

    def settle(key: PRNGKeyArray) -> Body:
        joints = rest + 0.05 * jax.random.uniform(key, rest.shape, minval=-1.0)  # rad
        base = jnp.array([0.0, 0.0, robot.standing_height, 1.0, 0.0, 0.0, 0.0])
        still = jnp.zeros(6 + len(rest))
        body = Body(jnp.concatenate([base, joints]), still, still)
        hold = lambda body, _: (
            physics.step(flat, body, jnp.stack([target, target]), jnp.int32(0), nominal)[0],
            None,
        )
        return jax.lax.scan(hold, body, None, length=steps)[0]

    keys = jax.random.split(jax.random.key(c.terrain.seed), c.episode.bank_size)
    # waited for: a program that calls the host must not outlive the interpreter
    return jax.block_until_ready(jax.jit(jax.vmap(settle))(keys))


def build_world(c: Config, engine: EngineName = "auto", threads: int = 0) -> World:
    """Build the world of a configuration; `threads` as in Physics."""
    return make_world(c, build_physics(c, engine, threads))


def build_physics(c: Config, engine: EngineName = "auto", threads: int = 0) -> Physics:
    """Build the physics of a configuration; `threads` as in Physics."""
    return Physics(c.robot, c.physics, resolve_engine(engine), threads)
