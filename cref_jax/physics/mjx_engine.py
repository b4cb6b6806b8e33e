"""One physics substep with MJX or with MuJoCo Warp: the engines for an accelerator (Sec. II-D).

MJX's own solver is written in JAX, and a substep of it is hundreds of kernels. MuJoCo Warp, which
MJX calls as well, does a substep of all robots in one call; it needs the extra `warp`.

This is the only module that knows `mujoco.mjx`.
"""

import contextlib
import importlib.util
import io

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from cref_jax.errors import ConfigError
from cref_jax.physics.records import Dynamics, Substep

with contextlib.redirect_stdout(io.StringIO()):  # it reports that warp-lang is not installed
    from mujoco import mjx


class MjxEngine:
    """Advances robots by one substep with MJX."""

    def __init__(self, model: mujoco.MjModel, trunk: int, foot_bodies: np.ndarray) -> None:
        """Take the compiled model, the trunk's body number and those of the feet."""
        self._model = mjx.put_model(model, impl="jax")
        self._data = mjx.make_data(model, impl="jax")
        self._trunk = trunk
        collide = lambda data: mjx.collision(self._model, mjx.kinematics(self._model, data))
        contact = jax.jit(collide)(self._data)._impl.contact  # without jit it takes 40 s
        owner = model.geom_bodyid[np.asarray(contact.geom)[:, 1]]
        self._foot = np.asarray(foot_bodies)[:, None] == owner[None, :]  # [F, contacts]
        self._rows = np.asarray(contact.efc_address)[:, None] + np.arange(4)  # pyramid's edges

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
        """Return the state one substep on.

        Full precision is asked for, or a GPU would round the factors of each product to 10 bits:
        the inertia that the light joints see would be off by some per cent.
        """
        state = (qpos, qvel, warmstart, target, plane_position, plane_rotation)
        with jax.default_matmul_precision("highest"):
            model = self.model(qpos, qvel, target, dynamics)
            after = mjx.step(model, _before(self._data, *state))
            force = self._foot_force(after)
        return Substep(after.qpos, after.qvel, after.qacc_warmstart, force)

    def model(
        self,
        qpos: Float[Array, " Q"],
        qvel: Float[Array, " V"],
        target: Float[Array, " M"],
        dynamics: Dynamics,
    ) -> mjx.Model:
        """Return the model of a robot with these dynamics, for one substep from this state.

        MuJoCo C leaves the damping of a motor that is at its limit out of what `implicitfast` takes
        for the derivative of the forces; MJX keeps it, as a brake that no motor has. So a motor at
        its limit becomes one of a constant torque, which is the same motor without that derivative.
        """
        model = _varied(self._model, self._trunk, dynamics)
        gain, bias = model.actuator_gainprm, model.actuator_biasprm
        low, high = model.actuator_forcerange.T  # N m
        torque = gain[:, 0] * target + bias[:, 1] * qpos[7:] + bias[:, 2] * qvel[6:]
        saturated = ((torque <= low) | (torque >= high))[:, None]
        constant = jnp.zeros_like(bias).at[:, 0].set(jnp.clip(torque, low, high))
        return model.replace(
            actuator_gainprm=jnp.where(saturated, 0.0, gain),
            actuator_biasprm=jnp.where(saturated, constant, bias),
        )

    def _foot_force(self, data: mjx.Data) -> Float[Array, "F 3"]:
        """Return the contact force on each foot, summed from the pyramids' edge forces.

        MJX's contact sensors repeat one pair's force, so the solver's forces are read instead.
        """
        contact = data._impl.contact
        edge = data._impl.efc_force[self._rows]  # [contacts, 4]
        in_contact = jnp.stack(
            [
                edge.sum(axis=1),
                contact.friction[:, 0] * (edge[:, 0] - edge[:, 1]),
                contact.friction[:, 1] * (edge[:, 2] - edge[:, 3]),
            ],
            axis=1,
        )
        in_world = jnp.einsum("ck,ckw->cw", in_contact, contact.frame)
        return self._foot.astype(np.float32) @ in_world


class WarpEngine:
    """Advances robots by one substep with MuJoCo Warp."""

    def __init__(self, model: mujoco.MjModel, trunk: int) -> None:
        """Take the compiled model with one force sensor a foot, and the trunk's body number.

        Raises:
            ConfigError: NVIDIA Warp is not installed.
        """
        if importlib.util.find_spec("warp") is None:
            raise ConfigError("engine 'warp' needs NVIDIA Warp: pip install 'cref-jax[warp]'")
        import warp  # pyright: ignore[reportMissingImports]

        warp.config.log_level = warp.LOG_WARNING  # it names each kernel that it loads
        constraints = 4 * model.npair + int(model.jnt_limited.sum())  # edges of pyramids, limits
        self._contacts = model.npair
        put = mjx.put_model(model, impl="warp")
        # or it reports each robot whose last iteration was not enough
        self._model = put.tree_replace({"opt._impl.warn_overflow": 0})
        self._data = mjx.make_data(
            model, impl="warp", naconmax=model.npair, naccdmax=0, njmax=constraints
        )
        self._trunk = trunk
        self._all = jax.custom_batching.custom_vmap(self._advanced)
        self._all.def_vmap(self._advanced_batches)

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
        robot = (qpos, qvel, warmstart, target, plane_position, plane_rotation, dynamics)
        after = self._all(*jax.tree.map(lambda x: jnp.asarray(x)[None], robot))
        return jax.tree.map(lambda x: x[0], after)

    def _advanced(self, *robots: Array | Dynamics) -> Substep:
        """Return the states of robots, their number the leading axis, one substep on."""
        data = self._room(len(robots[0]))

        def one(*robot: Array | Dynamics) -> Substep:
            *state, dynamics = robot
            after = mjx.step(_varied(self._model, self._trunk, dynamics), _before(data, *state))
            force = -after.sensordata.reshape(2, 3)  # of the ground on the foot
            return Substep(after.qpos, after.qvel, after.qacc_warmstart, force)

        return jax.vmap(one)(*robots)

    def _advanced_batches(
        self, size: int, is_batched: list[bool | Dynamics], *robots: Array | Dynamics
    ) -> tuple[Substep, Substep]:
        """Return `size` times as many robots one substep on, in one call with room for them all."""

        def flat(x: Array, batched: bool) -> Array:
            each = x if batched else jnp.broadcast_to(x, (size, *x.shape))
            return each.reshape(-1, *each.shape[2:])

        after = self._all(*jax.tree.map(flat, robots, tuple(is_batched)))
        split = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), after)
        return split, jax.tree.map(lambda _: True, split)

    def _room(self, robots: int) -> mjx.Data:
        """Return data with room for the contacts of so many robots, which they all share."""
        room, own = self._contacts * robots, self._data._impl
        contacts = {
            name: jnp.zeros((room, *x.shape[1:]), x.dtype)
            for name, x in vars(own).items()
            if name.startswith("contact__") and len(x)
        }
        return self._data.replace(_impl=own.replace(naconmax=room, **contacts))


def _before(
    data: mjx.Data,
    qpos: Float[Array, " Q"],
    qvel: Float[Array, " V"],
    warmstart: Float[Array, " V"],
    target: Float[Array, " M"],
    plane_position: Float[Array, "P 3"],
    plane_rotation: Float[Array, "P 4"],
) -> mjx.Data:
    """Return the data with a robot's state and its planes."""
    return data.replace(
        qpos=qpos,
        qvel=qvel,
        qacc_warmstart=warmstart,
        ctrl=target,
        mocap_pos=plane_position,
        mocap_quat=plane_rotation,
    )


def _varied(model: mjx.Model, trunk: int, dynamics: Dynamics) -> mjx.Model:
    """Return the model with a robot's own dynamics."""
    bias, driven = model.actuator_biasprm, np.arange(dynamics.kp.size)
    return model.replace(
        pair_friction=model.pair_friction.at[:, :2].set(dynamics.friction),
        body_mass=model.body_mass.at[trunk].add(dynamics.payload),
        body_ipos=model.body_ipos.at[trunk].add(dynamics.com_shift),
        actuator_gainprm=model.actuator_gainprm.at[driven, 0].set(dynamics.kp),
        actuator_biasprm=bias.at[driven, 1].set(-dynamics.kp).at[driven, 2].set(-dynamics.kd),
    )
