"""Domain randomisation: what is drawn anew at each reset."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cref_jax import config
from cref_jax.env.state import Spread
from cref_jax.env.world import World
from cref_jax.physics.records import Dynamics


def sample_dynamics(
    world: World, key: PRNGKeyArray, spread: Spread
) -> tuple[Dynamics, Float[Array, " J"], Int[Array, ""]]:
    """Draw the robot's dynamics, its encoder offsets and its action delay in substeps."""
    c, nominal = world.config.randomisation, world.physics.nominal_dynamics()
    if not c.enabled:
        return nominal, jnp.zeros_like(nominal.kp), jnp.zeros((), jnp.int32)
    keys = jax.random.split(key, 7)
    draw = lambda k, shape, low, high: jax.random.uniform(k, shape, minval=low, maxval=high)
    within = lambda middle, share, drawn: middle + share * (drawn - middle)
    joints = nominal.kp.shape
    dynamics = Dynamics(
        friction=within(nominal.friction, spread.friction, draw(keys[0], (), *c.friction)),
        payload=spread.mass * draw(keys[1], (), -c.trunk_mass, c.trunk_mass),
        com_shift=spread.mass * draw(keys[2], (3,), -c.trunk_com, c.trunk_com),
        kp=nominal.kp * within(1.0, spread.gains, draw(keys[3], joints, *c.gains)),
        kd=nominal.kd * within(1.0, spread.gains, draw(keys[4], joints, *c.gains)),
    )
    most = round(c.action_delay / world.config.physics.timestep)
    delay = jax.random.randint(keys[6], (), 0, most + 1)
    return (
        dynamics,
        spread.offsets * draw(keys[5], joints, -c.joint_offset, c.joint_offset),
        jnp.round(spread.delay * delay).astype(jnp.int32),
    )


def sample_camera_mount(
    c: config.Randomisation, key: PRNGKeyArray
) -> tuple[Float[Array, ""], Float[Array, "3"]]:
    """Draw the errors of the camera's mount: pitch, rad, and position, m."""
    if not c.enabled:
        return jnp.zeros(()), jnp.zeros(3)
    key_pitch, key_shift = jax.random.split(key)
    pitch = np.deg2rad(c.camera_pitch)
    return (
        jax.random.uniform(key_pitch, (), minval=-pitch, maxval=pitch),
        jax.random.uniform(key_shift, (3,), minval=-c.camera_position, maxval=c.camera_position),
    )


def sample_steps(c: config.Config, key: PRNGKeyArray, span: tuple[float, float]) -> Int[Array, ""]:
    """Draw a time within `span` s, in control steps."""
    low, high = (round(t / c.physics.control_period) for t in span)
    return jax.random.randint(key, (), low, high + 1)
