"""Physics substeps with MJX or MuJoCo Warp, the engines for an accelerator (Sec. II-D).

MJX's own solver is written in JAX; one substep is hundreds of kernels. MuJoCo Warp, called through
MJX as well, computes a substep of all robots in one call; it needs the extra `warp`.

This is the only module that imports `mujoco.mjx`.
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
from cref_jax.physics.records import Dynamics, Substep, SubstepInput

with contextlib.redirect_stdout(io.StringIO()):  # MJX reports a missing warp-lang
    from mujoco import mjx


class MjxEngine:
    """Advances robots by one substep with MJX."""

    def __init__(self, model: mujoco.MjModel, trunk: int, foot_bodies: np.ndarray) -> None:
        """Set up MJX for the compiled model; `trunk` and `foot_bodies` are body ids."""
        self._model = mjx.put_model(model, impl="jax")
        self._data = mjx.make_data(model, impl="jax")
        self._trunk = trunk
        collide = lambda data: mjx.collision(self._model, mjx.kinematics(self._model, data))
        contact = jax.jit(collide)(self._data)._impl.contact  # 40 s without jit
        owner = model.geom_bodyid[np.asarray(contact.geom)[:, 1]]
        self._foot = np.asarray(foot_bodies)[:, None] == owner[None, :]  # [F, contacts]
        self._rows = np.asarray(contact.efc_address)[:, None] + np.arange(4)  # edges of the pyramid

    def substep(self, robot: SubstepInput) -> Substep:
        """Advance one robot by one substep.

        Matrix products use full precision: a GPU would otherwise round their factors to 10 bits,
        and the effective inertia of the light joints would be off by several per cent.
        """
        *state, dynamics = robot
        with jax.default_matmul_precision("highest"):
            model = self.model(robot.qpos, robot.qvel, robot.target, dynamics)
            after = mjx.step(model, _load_state(self._data, *state))
            force = self._foot_force(after)
        return Substep(after.qpos, after.qvel, after.qacc_warmstart, force)

    def model(
        self,
        qpos: Float[Array, " Q"],
        qvel: Float[Array, " V"],
        target: Float[Array, " M"],
        dynamics: Dynamics,
    ) -> mjx.Model:
        """Build the model of a robot with these dynamics, for one substep from this state.

        For a saturated motor, MuJoCo C omits the damping from the force derivatives of
        `implicitfast`; MJX keeps it, which brakes as no real motor does. So a saturated motor is
        replaced by a constant torque, the same motor without that derivative.
        """
        model = _apply_dynamics(self._model, self._trunk, dynamics)
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
        """Compute the contact force on each foot, N, from the pyramids' edge forces.

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
        """Set up Warp for the compiled model, with one force sensor per foot and `trunk`'s body id.

        Raises:
            ConfigError: NVIDIA Warp is not installed.
        """
        if importlib.util.find_spec("warp") is None:
            raise ConfigError("engine 'warp' needs NVIDIA Warp: pip install 'cref-jax[warp]'")
        import warp  # pyright: ignore[reportMissingImports]

        warp.config.log_level = warp.LOG_WARNING  # else it logs each kernel that it loads
        constraints = 4 * model.npair + int(model.jnt_limited.sum())  # edges of pyramids, limits
        self._contacts = model.npair
        put = mjx.put_model(model, impl="warp")
        # else it reports each robot whose solver ran out of iterations
        self._model = put.tree_replace({"opt._impl.warn_overflow": 0})
        self._data = mjx.make_data(
            model, impl="warp", naconmax=model.npair, naccdmax=0, njmax=constraints
        )
        self._trunk = trunk
        self._advance_all = jax.custom_batching.custom_vmap(self._advance)
        self._advance_all.def_vmap(self._advance_batches)

    def substep(self, robot: SubstepInput) -> Substep:
        """Advance one robot by one substep."""
        after = self._advance_all(*jax.tree.map(lambda x: jnp.asarray(x)[None], robot))
        return jax.tree.map(lambda x: x[0], after)

    def _advance(self, *robots: Array | Dynamics) -> Substep:
        """Advance all robots, the leading axis, by one substep."""
        data = self._allocate_contacts(len(robots[0]))

        def one(*robot: Array | Dynamics) -> Substep:
            *state, dynamics = robot
            after = mjx.step(
                _apply_dynamics(self._model, self._trunk, dynamics), _load_state(data, *state)
            )
            force = -after.sensordata.reshape(2, 3)  # by the ground on the foot
            return Substep(after.qpos, after.qvel, after.qacc_warmstart, force)

        return jax.vmap(one)(*robots)

    def _advance_batches(
        self, size: int, is_batched: list[bool | Dynamics], *robots: Array | Dynamics
    ) -> tuple[Substep, Substep]:
        """Advance `size` batches of robots by one substep, in one call with room for all."""

        def flat(x: Array, batched: bool) -> Array:
            each = x if batched else jnp.broadcast_to(x, (size, *x.shape))
            return each.reshape(-1, *each.shape[2:])

        after = self._advance_all(*jax.tree.map(flat, robots, tuple(is_batched)))
        split = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), after)
        return split, jax.tree.map(lambda _: True, split)

    def _allocate_contacts(self, robots: int) -> mjx.Data:
        """Allocate data whose shared contact buffers fit this number of robots."""
        room, own = self._contacts * robots, self._data._impl
        contacts = {
            name: jnp.zeros((room, *x.shape[1:]), x.dtype)
            for name, x in vars(own).items()
            if name.startswith("contact__") and len(x)
        }
        return self._data.replace(_impl=own.replace(naconmax=room, **contacts))


def _load_state(
    data: mjx.Data,
    qpos: Float[Array, " Q"],
    qvel: Float[Array, " V"],
    warmstart: Float[Array, " V"],
    target: Float[Array, " M"],
    plane_position: Float[Array, "P 3"],
    plane_rotation: Float[Array, "P 4"],
) -> mjx.Data:
    """Load a robot's state and its planes into the data."""
    return data.replace(
        qpos=qpos,
        qvel=qvel,
        qacc_warmstart=warmstart,
        ctrl=target,
        mocap_pos=plane_position,
        mocap_quat=plane_rotation,
    )


def _apply_dynamics(model: mjx.Model, trunk: int, dynamics: Dynamics) -> mjx.Model:
    """Apply a robot's own dynamics to the model."""
    bias, driven = model.actuator_biasprm, np.arange(dynamics.kp.size)
    return model.replace(
        pair_friction=model.pair_friction.at[:, :2].set(dynamics.friction),
        body_mass=model.body_mass.at[trunk].add(dynamics.payload),
        body_ipos=model.body_ipos.at[trunk].add(dynamics.com_shift),
        actuator_gainprm=model.actuator_gainprm.at[driven, 0].set(dynamics.kp),
        actuator_biasprm=bias.at[driven, 1].set(-dynamics.kp).at[driven, 2].set(-dynamics.kd),
    )
