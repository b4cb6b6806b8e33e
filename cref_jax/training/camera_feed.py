"""The cameras of all robots on one clock: frames rendered, held and delivered."""

import functools
from typing import no_type_check

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float16, Int

from cref_jax import config, depth, network
from cref_jax.env import environment
from cref_jax.env.state import EnvState
from cref_jax.env.world import World
from cref_jax.system import xla_kernels


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@flax.struct.dataclass
class CameraFeed:
    """What the cameras have delivered."""

    frame: Float16[Array, "E rows columns pixels"]  # D, the last that came, see network.in_patches
    seen: Bool[Array, " E"]  # it is of this episode
    fresh: Bool[Array, ""]  # it came in the last step
    clock: Int[Array, ""]  # control steps since the cameras were started

    def images(self, c: config.Network) -> Float16[Array, "E H W"]:
        """Return the frames as images."""
        return network.as_image(c, self.frame)


def render_frames(world: World, state: EnvState) -> Float16[Array, "E rows columns pixels"]:
    """Return what all cameras see, in the order in which the network reads it.

    `start` puts the robots on the kinds of lane in turn, for good: so it is known beforehand which
    of them stand on lanes that are level across, and these images cost less.
    """
    kinds = world.lanes.kind_of(np.arange(state.kind.shape[0]))
    is_profile = np.asarray(world.lanes.is_profile)[kinds]
    robots, images = [], []
    for flag in (True, False):
        some = np.flatnonzero(is_profile == flag)
        if some.size:
            part = jax.tree.map(lambda x, some=some: x[some], state)
            look = xla_kernels.as_own_kernel(functools.partial(_render_images, is_profile=flag))
            images.append(xla_kernels.materialize(look(world, part)))
            robots.append(some)
    image = jnp.concatenate(images)[np.argsort(np.concatenate(robots))]
    return network.in_patches(world.config.network, image)


def _render_images(world: World, state: EnvState, is_profile: bool) -> Float16[Array, "E H W"]:
    """Return what cameras see that are all on lanes level across, or all not."""
    look = functools.partial(environment.depth_image, is_profile=is_profile)
    return jax.vmap(look, in_axes=(None, 0))(world, state).astype(jnp.float16)


def empty_feed(c: config.Config, num_envs: int) -> CameraFeed:
    """Return the state of cameras that have delivered nothing."""
    blank = jnp.zeros((num_envs, *c.camera.shape), jnp.float16)  # 16 bits: to 0.4 mm at 3 m
    return CameraFeed(
        frame=network.in_patches(c.network, blank),
        seen=jnp.zeros(num_envs, bool),
        fresh=jnp.zeros((), bool),
        clock=jnp.zeros((), jnp.int32),
    )


def update_feed(
    world: World, feed: CameraFeed, before: EnvState, over: Bool[Array, " E"]
) -> CameraFeed:
    """Return what has been delivered after the step that led away from the states `before`.

    A frame shows the robot one control step earlier: it is 20 ms old when the policy first uses it
    (assumed). One that was exposed before the end of an episode is not shown to the next.
    """
    c, clock = world.config, feed.clock + 1
    due = depth.is_due(clock, c.camera, c.physics.control_period)
    frame = jax.lax.cond(due, lambda: render_frames(world, before), lambda: feed.frame)
    return CameraFeed(frame=frame, seen=(feed.seen | due) & ~over, fresh=due, clock=clock)
