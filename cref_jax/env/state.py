"""The state of one environment, and why an episode ends."""

from typing import NamedTuple, no_type_check

import flax.struct
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from cref_jax.env.footholds import Candidates
from cref_jax.env.gait import Gait
from cref_jax.physics.records import Body, Dynamics


class Spread(NamedTuple):
    """Share of its ranges that each part of the randomisation uses, 0 to 1."""

    friction: Float[ArrayLike, ""]
    mass: Float[ArrayLike, ""]  # of the trunk, and where its centre is
    gains: Float[ArrayLike, ""]
    offsets: Float[ArrayLike, ""]  # of encoders
    delay: Float[ArrayLike, ""]
    noise: Float[ArrayLike, ""]
    pushes: Float[ArrayLike, ""]
    camera: Float[ArrayLike, ""]  # how it is mounted


def even_spread(share: Float[ArrayLike, "*n"]) -> Spread:
    """Return the same share of every part."""
    return Spread(*[jnp.asarray(share, jnp.float32)] * len(Spread._fields))


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@flax.struct.dataclass
class EnvState:
    """One robot between two control steps."""

    key: PRNGKeyArray
    body: Body
    spread: Spread
    dynamics: Dynamics
    joint_offset: Float[Array, " J"]  # rad, encoder zero
    delay: Int[Array, ""]  # substeps until a new target arrives
    kind: Int[Array, ""]  # of terrain
    level: Int[Array, ""]  # of difficulty, of the lane that it is on
    variant: Int[Array, ""]  # which lane of that level
    rank: Int[Array, ""]  # the hardest level that it has earned
    start: Float[Array, "2"]  # m, where the episode began
    command: Float[Array, "3"]  # m/s, m/s, rad/s
    is_steered: Bool[Array, ""]  # its yaw rate leads along the lane
    command_left: Int[Array, ""]  # control steps until the next draw
    push_left: Int[Array, ""]  # control steps until the next push
    commanded: Float[Array, ""]  # m, distance asked for so far, along the lane where there is one
    mark: Float[Array, "2"]  # m, x and the distance asked for at the last look for a stall
    action: Float[Array, " J"]  # a_{t-1}
    action_before: Float[Array, " J"]  # a_{t-2}
    foot_velocity: Float[Array, "F 3"]  # m/s, world
    gait: Gait
    since_single: Float[Array, ""]  # s since one foot alone was down, as of `gait`
    support_z: Float[Array, ""]  # m, height of the last support
    candidates: Candidates  # where each foot may step, as seen when it last bore on the ground
    foothold_distance: Float[Array, " F"]  # m, of each sole from the nearest of them, up to a limit
    camera_pitch: Float[Array, ""]  # rad, error of the camera's mount
    camera_shift: Float[Array, "3"]  # m, error of the camera's mount
    step: Int[Array, ""]  # control steps into the episode


class Ending(NamedTuple):
    """Why an episode is over; the first five are failures."""

    tilted: Bool[Array, ""]
    low: Bool[Array, ""]  # the pelvis is too near to the support
    hit: Bool[Array, ""]  # torso, head, pelvis or thigh is in the terrain
    dropped: Bool[Array, ""]  # a foot is far below the last support
    unstable: Bool[Array, ""]  # the physics has blown up
    stalled: Bool[Array, ""]  # it hardly moves, though it is told to walk
    finished: Bool[Array, ""]  # at the lane's end
    timeout: Bool[Array, ""]

    @property
    def terminated(self) -> Bool[ArrayLike, "..."]:
        """The robot has failed: no value follows."""
        return self.tilted | self.low | self.hit | self.dropped | self.unstable

    @property
    def truncated(self) -> Bool[ArrayLike, "..."]:
        """The episode was cut although the robot could have continued."""
        return (self.finished | self.timeout | self.stalled) & ~self.terminated


class Draws(NamedTuple):
    """The next push and the next command, and the control steps until those after them."""

    shove: Float[Array, "2"]  # m/s
    turn: Float[Array, ""]  # rad/s, about the body's z
    push_left: Int[Array, ""]
    command: Float[Array, "3"]  # m/s, m/s, rad/s
    is_steered: Bool[Array, ""]
    command_left: Int[Array, ""]
