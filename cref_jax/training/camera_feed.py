"""The cameras of all robots, on one clock: frames are rendered, held and delivered."""

import functools
from collections.abc import Callable
from typing import no_type_check

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float16, Int, PyTree

from cref_jax import config, depth, network
from cref_jax.env import environment
from cref_jax.env.state import EnvState
from cref_jax.env.world import World
from cref_jax.system import xla_kernels

Images = PyTree[Float[Array, "H W"]]


@no_type_check  # vmap and tree.map fill it with batches and with non-arrays
@flax.struct.dataclass
class CameraFeed:
    """The latest delivered frames."""

    frame: Float16[Array, "E rows columns pixels"]  # D, latest frame, see network.image_to_patches
    seen: Bool[Array, " E"]  # the frame is of this episode
    fresh: Bool[Array, ""]  # the frame came in the last step
    clock: Int[Array, ""]  # control steps since the cameras started
    clear: Float16[Array, "E rows columns pixels"] | None = None  # without faults, for teachers

    def images(self, c: config.Network) -> Float16[Array, "E H W"]:
        """Convert the frames to images."""
        return network.patches_to_image(c, self.frame)


def render_frames(world: World, state: EnvState) -> Float16[Array, "E rows columns pixels"]:
    """Render every robot's depth image, in the network's patch order."""
    return _render_all(world, state, environment.depth_image)


def _render_all(
    world: World, state: EnvState, look: Callable[..., Images]
) -> PyTree[Float16[Array, "E rows columns pixels"]]:
    """Render every robot's images, in the network's patch order.

    `start` assigns each robot its kind of lane for good, so it is known at compile time which lanes
    are level across; their images are cheaper.
    """
    kinds = world.lanes.kind_of(np.arange(state.kind.shape[0]))
    is_profile = np.asarray(world.lanes.is_profile)[kinds]
    robots, images = [], []
    for flag in (True, False):
        some = np.flatnonzero(is_profile == flag)
        if some.size:
            part = jax.tree.map(lambda x, some=some: x[some], state)
            render = functools.partial(_render_images, look=look, is_profile=flag)
            render = xla_kernels.as_own_kernel(render)
            images.append(xla_kernels.materialize(render(world, part)))
            robots.append(some)
    order = np.argsort(np.concatenate(robots))
    to_patches = functools.partial(network.image_to_patches, world.config.network)
    return jax.tree.map(lambda *parts: to_patches(jnp.concatenate(parts)[order]), *images)


def _render_images(
    world: World, state: EnvState, look: Callable[..., Images], is_profile: bool
) -> PyTree[Float16[Array, "E H W"]]:
    """Render the images of robots that are all on lanes level across, or all not."""
    each = functools.partial(look, is_profile=is_profile)
    images = jax.vmap(each, in_axes=(None, 0))(world, state)
    return jax.tree.map(lambda image: image.astype(jnp.float16), images)


def empty_feed(c: config.Config, num_envs: int) -> CameraFeed:
    """Create the state of cameras that have delivered no frame."""
    blank = jnp.zeros((num_envs, *c.camera.shape), jnp.float16)  # 16 bits: to 0.4 mm at 3 m
    return CameraFeed(
        frame=network.image_to_patches(c.network, blank),
        seen=jnp.zeros(num_envs, bool),
        fresh=jnp.zeros((), bool),
        clock=jnp.zeros((), jnp.int32),
    )


def update_feed(
    world: World, feed: CameraFeed, before: EnvState, over: Bool[Array, " E"]
) -> CameraFeed:
    """Advance the cameras by one control step, which started from the states `before`.

    A frame shows the robot one control step earlier: it is 20 ms old when the policy first uses it
    (assumed). A frame exposed before the end of an episode is not shown to the next.
    """
    c, clock = world.config, feed.clock + 1
    due = depth.is_due(clock, c.camera, c.physics.control_period)
    if feed.clear is None:
        frame = jax.lax.cond(due, lambda: render_frames(world, before), lambda: feed.frame)
        clear = None
    else:
        both = lambda: _render_all(world, before, environment.depth_images)
        frame, clear = jax.lax.cond(due, both, lambda: (feed.frame, feed.clear))
    seen = (feed.seen | due) & ~over
    return CameraFeed(frame=frame, seen=seen, fresh=due, clock=clock, clear=clear)
