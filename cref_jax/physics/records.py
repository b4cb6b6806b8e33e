"""What every physics engine takes and returns."""

from typing import Literal, NamedTuple, Protocol

from jaxtyping import Array, Float


class Dynamics(NamedTuple):
    """What differs from one robot to the next; drawn anew at each reset."""

    friction: Float[Array, ""]  # sliding friction coefficient
    payload: Float[Array, ""]  # kg added to the trunk
    com_shift: Float[Array, "3"]  # m, shift of the trunk's centre of mass, in its frame
    kp: Float[Array, " J"]  # N m / rad
    kd: Float[Array, " J"]  # N m s / rad


class Substep(NamedTuple):
    """What a physics substep returns."""

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
    """Advances one robot by one substep; `jax.vmap` gives many."""

    def substep(
        self,
        qpos: Float[Array, " Q"],
        qvel: Float[Array, " V"],
        warmstart: Float[Array, " V"],
        target: Float[Array, " M"],
        plane_position: Float[Array, "P 3"],
        plane_rotation: Float[Array, "P 4"],
        dynamics: Dynamics,
    ) -> Substep:
        """Return the state one substep on."""
        ...
