"""Inputs and outputs of every physics engine."""

from typing import Literal, NamedTuple, Protocol

from jaxtyping import Array, Float


class Dynamics(NamedTuple):
    """Randomised parameters of one robot, sampled at each reset."""

    friction: Float[Array, ""]  # sliding friction coefficient
    payload: Float[Array, ""]  # kg added to the trunk
    com_shift: Float[Array, "3"]  # m, shift of the trunk's centre of mass, in its frame
    kp: Float[Array, " J"]  # N m / rad
    kd: Float[Array, " J"]  # N m s / rad


class SubstepInput(NamedTuple):
    """The state of one robot, what its motors aim at, and the planes that it touches."""

    qpos: Float[Array, " Q"]  # m, quaternion, rad
    qvel: Float[Array, " V"]  # m/s, rad/s
    warmstart: Float[Array, " V"]  # the solver's last acceleration
    target: Float[Array, " M"]  # rad, of all joints that move
    plane_position: Float[Array, "P 3"]  # m
    plane_rotation: Float[Array, "P 4"]  # quaternion w, x, y, z
    dynamics: Dynamics


class Substep(NamedTuple):
    """The result of a physics substep."""

    qpos: Float[Array, " Q"]  # m, quaternion, rad
    qvel: Float[Array, " V"]  # m/s, rad/s
    warmstart: Float[Array, " V"]  # the solver's last acceleration
    force: Float[Array, "F 3"]  # N, contact force on each foot, world frame


Backend = Literal["mjx", "mujoco", "warp"]
EngineName = Literal["auto", "mjx", "mujoco", "warp"]


class Body(NamedTuple):
    """The robot's mechanical state, in the lane's own coordinates."""

    qpos: Float[Array, " Q"]  # m, quaternion (w x y z), rad
    qvel: Float[Array, " V"]  # m/s in the world frame, rad/s in the body frame, rad/s
    warmstart: Float[Array, " V"]  # the solver's last acceleration


class Engine(Protocol):
    """Advances one robot by one substep; batch it with `jax.vmap`."""

    def substep(self, robot: SubstepInput) -> Substep:
        """Advance one robot by one substep."""
        ...
