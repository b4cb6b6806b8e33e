"""A small world and robots in it, made once and shared by the tests of episode and environment."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from cref_jax import config, robot
from cref_jax.config import Config
from cref_jax.env import resets
from cref_jax.env.state import EnvState
from cref_jax.env.world import World, make_world
from cref_jax.physics.simulation import Physics

C = config.override(
    robot.fill_in(Config()),
    {"terrain": {"name": "mixed", "levels": 3, "lane_width": 1.0}, "episode": {"bank_size": 8}},
)
ROBOTS = 8


@functools.cache
def world() -> World:
    """Return lanes of every kind; the engine is MuJoCo C."""
    return make_world(C, Physics(C.robot, C.physics, "mujoco", threads=2))


@functools.cache
def fresh_states() -> EnvState:
    """Return 512 robots at their start, of every kind and level in turn."""
    number, lanes = np.arange(512), world().lanes
    kinds, levels = jnp.asarray(lanes.kind_of(number)), jnp.asarray(number // len(lanes.turns) % 3)
    reset = jax.jit(jax.vmap(resets.reset, in_axes=(None, 0, 0, 0)))
    return reset(world(), jax.random.split(jax.random.key(3), 512), kinds, levels)


def robots() -> EnvState:
    """Return eight robots, one a kind and two on stairs up."""
    return one(fresh_states(), np.arange(ROBOTS))


def one(tree, index=0):
    """Return the part of a batch at `index`."""
    return jax.tree.map(lambda x: x[index], tree)


def put(state: EnvState, **changes) -> EnvState:
    """Return the state with the base's `x y z rotation` and the fields of the state changed."""
    qpos = state.body.qpos
    for key, where in {"x": 0, "y": 1, "z": 2, "rotation": slice(3, 7)}.items():
        if key in changes:
            qpos = qpos.at[..., where].set(changes.pop(key))
    return state.replace(body=state.body._replace(qpos=qpos), **changes)


def on(kind: str, state: EnvState, level: int = 0) -> EnvState:
    """Return the state moved to a lane of this kind."""
    return state.replace(kind=jnp.int32(world().lanes.kinds.index(kind)), level=jnp.int32(level))


def assert_equal(a, b) -> None:
    """Assert that two trees are the same, bit for bit."""
    raw = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(raw(x), raw(y)), a, b)
