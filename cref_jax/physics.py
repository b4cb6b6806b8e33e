"""The physics step, with terrain contact by tangent planes (Sec. II-D).

Each contact sphere owns a plane. Before every substep the terrain is asked for the surface point
and normal nearest to the sphere, and the plane is put there. The engine sees only planes against
spheres: one contact a plane, at constant cost, the same in MJX and in MuJoCo C.

This is the only module that knows `mujoco.mjx`.
"""

import contextlib
import io
from typing import Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cref_jax import config, geometry, kinematics, robot, terrain
from cref_jax.host_physics import Dynamics, HostEngine, Substep

with contextlib.redirect_stdout(io.StringIO()):  # it reports that warp-lang is not installed
    from mujoco import mjx

MAX_DEPTH = 0.05  # m; a foot that swings at 8 m/s is 4 cm in a wall after one substep
EngineName = Literal["auto", "mjx", "mujoco"]


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


class Physics:
    """One robot on one terrain: what does not change while it is simulated."""

    def __init__(
        self,
        robot_config: config.Robot,
        physics_config: config.Physics,
        engine: Literal["mjx", "mujoco"],
        threads: int = 0,
    ) -> None:
        """Compile the model and make the engine; `threads` is for MuJoCo C, 0 means all cores."""
        self.config = physics_config
        self.robot = robot.load(robot_config)
        self.feet = np.array(self.robot.ankles)  # body ids
        spec = robot.spec(robot.moving(robot_config), physics_config)
        if engine == "mujoco":
            robot.add_force_sensors(spec)
        self.model = spec.compile()
        self.tree = kinematics.tree(self.model)
        self.engine: Engine = (
            HostEngine(self.model, self.robot.trunk, threads)
            if engine == "mujoco"
            else _MjxEngine(self.model, self.robot.trunk, self.feet)
        )

    def nominal_dynamics(self) -> Dynamics:
        """Return the dynamics of the robot as it is, on nominal ground."""
        return Dynamics(
            friction=jnp.float32(robot.FRICTION),
            payload=jnp.float32(0.0),
            com_shift=jnp.zeros(3),
            kp=jnp.asarray(self.robot.kp),
            kd=jnp.asarray(self.robot.kd),
        )

    def links(self, body: Body) -> kinematics.Links:
        """Return the pose and velocity of every link."""
        return kinematics.links(self.tree, body.qpos, body.qvel)

    def planes(
        self, ground: terrain.Terrain, body: Body
    ) -> tuple[Float[Array, "P 3"], Float[Array, "P 4"]]:
        """Return position and rotation of the terrain's tangent plane under each sphere.

        A plane is never more than `MAX_DEPTH` above its sphere's centre: a sphere that was thrown
        deep into a wall comes out at the speed of a collision and not of an explosion.
        """
        spheres = self.robot.spheres
        centres = kinematics.points(self.links(body), spheres.body, spheres.position)
        _, normal, distance = jax.vmap(lambda p: terrain.closest_point(ground, p))(centres)
        point = centres - normal * jnp.maximum(distance, -MAX_DEPTH)[:, None]
        return point, jax.vmap(geometry.quat_from_z)(normal)

    def is_hit(self, ground: terrain.Terrain, links: kinematics.Links) -> Bool[Array, ""]:
        """Return whether an end of pelvis, torso, head or a thigh touches the ground.

        A wall ahead is noticed from as far as `closest_point` looks.
        """
        capsules = self.robot.capsules
        clear = capsules.kept_clear
        ends = np.concatenate([capsules.start[clear], capsules.end[clear]])
        body, radius = np.tile(capsules.body[clear], 2), np.tile(capsules.radius[clear], 2)
        points = kinematics.points(links, body, ends)
        _, _, distance = jax.vmap(lambda p: terrain.closest_point(ground, p))(points)
        return jnp.any(distance < radius)

    def step(
        self,
        ground: terrain.Terrain,
        body: Body,
        targets: Float[Array, "2 J"],
        delay: Int[Array, ""],
        dynamics: Dynamics,
    ) -> tuple[Body, Float[Array, "F 3"]]:
        """Advance one control step; return the state and the mean force on each foot, N.

        `targets` are the previous and the new joint targets, rad; the new one arrives after `delay`
        substeps. The joints that are held keep theirs.
        """
        held = jnp.asarray(self.robot.rest_pose[len(self.robot.nominal_pose) :])

        def substep(body: Body, k: Int[Array, ""]) -> tuple[Body, Float[Array, "F 3"]]:
            target = jnp.concatenate([jnp.where(k < delay, targets[0], targets[1]), held])
            after = self.engine.substep(*body, target, *self.planes(ground, body), dynamics)
            return Body(after.qpos, after.qvel, after.warmstart), after.force

        body, force = jax.lax.scan(substep, body, jnp.arange(self.config.substeps))
        return body, force.mean(axis=0)


def resolve_engine(name: EngineName) -> Literal["mjx", "mujoco"]:
    """Return the engine for this machine: MuJoCo C on a CPU, MJX on an accelerator."""
    if name != "auto":
        return name
    return "mujoco" if jax.default_backend() == "cpu" else "mjx"


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


class _MjxEngine:
    """Advances robots by one substep with MJX: the engine for an accelerator."""

    def __init__(self, model: mujoco.MjModel, trunk: int, foot_bodies: np.ndarray) -> None:
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
        before = self._data.replace(
            qpos=qpos,
            qvel=qvel,
            qacc_warmstart=warmstart,
            ctrl=target,
            mocap_pos=plane_position,
            mocap_quat=plane_rotation,
        )
        with jax.default_matmul_precision("highest"):
            after = mjx.step(self.model(qpos, qvel, target, dynamics), before)
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
