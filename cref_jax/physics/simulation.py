"""The physics step, with terrain contact by tangent planes (Sec. II-D).

Each contact sphere owns a plane. Before every substep the plane is moved to the surface point
nearest to the sphere, along the normal there. The engine sees only planes against spheres: one
contact per plane, at constant cost, the same in every engine.
"""

import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cref_jax import config, geometry, robot, terrain
from cref_jax.physics.mjx_engine import MjxEngine, WarpEngine
from cref_jax.physics.mujoco_engine import MujocoEngine
from cref_jax.physics.records import Backend, Body, Dynamics, Engine, EngineName, SubstepInput
from cref_jax.robot import kinematics

WALL = 0.7  # least vertical part of a normal on ground, largest on a wall; assumed: 45 degrees
MAX_DEPTH = 0.05  # m; a foot swinging at 8 m/s is 4 cm inside a wall after one substep


class Physics:
    """One robot's model and engine, which stay constant during a simulation."""

    def __init__(
        self,
        robot_config: config.Robot,
        physics_config: config.Physics,
        engine: Backend,
        threads: int = 0,
    ) -> None:
        """Compile the model and create the engine; `threads` for MuJoCo C, 0: all cores.

        Raises:
            ConfigError: the engine is not installed.
        """
        self.config = physics_config
        self.robot = robot.load(robot_config)
        self.feet = np.array(self.robot.ankles)  # body ids
        name = robot_config.name
        spec = robot.spec(robot.moving(robot_config), physics_config, name=name)
        if engine != "mjx":
            robot.add_force_sensors(spec, name)
        if engine == "mujoco":
            robot.solve_sparsely(spec)
        if engine == "warp":  # it never resets a state itself and rejects the flag
            spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.model = spec.compile()
        self.tree = kinematics.tree(self.model)
        self.engine: Engine
        if engine == "mujoco":
            self.engine = MujocoEngine(self.model, self.robot.trunk, threads)
        elif engine == "warp":
            self.engine = WarpEngine(self.model, self.robot.trunk)
        else:
            self.engine = MjxEngine(self.model, self.robot.trunk, self.feet)

    def nominal_dynamics(self) -> Dynamics:
        """Return the dynamics of the nominal robot on nominal ground."""
        return Dynamics(
            friction=jnp.float32(robot.FRICTION),
            payload=jnp.float32(0.0),
            com_shift=jnp.zeros(3),
            kp=jnp.asarray(self.robot.kp),
            kd=jnp.asarray(self.robot.kd),
        )

    def links(self, body: Body) -> kinematics.Links:
        """Compute the pose and velocity of every link."""
        return kinematics.links(self.tree, body.qpos, body.qvel)

    def planes(
        self, ground: terrain.Terrain, body: Body
    ) -> tuple[Float[Array, "P 3"], Float[Array, "P 4"]]:
        """Compute position and rotation of the terrain's tangent plane under each sphere.

        A plane is at most `MAX_DEPTH` above its sphere's centre: a sphere thrown deep into a wall
        comes out at the speed of a collision, not of an explosion.
        """
        centres, normal, distance = self._find_surfaces(ground, self.links(body))
        point = centres - normal * jnp.maximum(distance, -MAX_DEPTH)[:, None]
        return point, jax.vmap(geometry.quat_from_z)(normal)

    def at_wall(self, ground: terrain.Terrain, links: kinematics.Links) -> Bool[Array, " P"]:
        """Check of each contact sphere whether the nearest surface is a wall, and touches it."""
        _, normal, distance = self._find_surfaces(ground, links)
        return (distance < self.robot.spheres.radius) & (jnp.abs(normal[:, 2]) < WALL)

    def _find_surfaces(
        self, ground: terrain.Terrain, links: kinematics.Links
    ) -> tuple[Float[Array, "P 3"], Float[Array, "P 3"], Float[Array, " P"]]:
        """Compute each contact sphere's centre, and the nearest surface's normal and distance."""
        spheres = self.robot.spheres
        centres = kinematics.points(links, spheres.body, spheres.position)
        _, normal, distance = jax.vmap(lambda p: terrain.closest_point(ground, p))(centres)
        return centres, normal, distance

    def is_hit(self, ground: terrain.Terrain, links: kinematics.Links) -> Bool[Array, ""]:
        """Check whether an end of pelvis, torso, head or a thigh touches the ground.

        Walls are detected within the search distance of `closest_point`.
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
        substeps. Joints held by the robot keep their rest pose.
        """
        held = jnp.asarray(self.robot.rest_pose[len(self.robot.nominal_pose) :])

        def substep(body: Body, k: Int[Array, ""]) -> tuple[Body, Float[Array, "F 3"]]:
            target = jnp.concatenate([jnp.where(k < delay, targets[0], targets[1]), held])
            planes = self.planes(ground, body)
            after = self.engine.substep(SubstepInput(*body, target, *planes, dynamics))
            return Body(after.qpos, after.qvel, after.warmstart), after.force

        body, force = jax.lax.scan(substep, body, jnp.arange(self.config.substeps))
        return body, force.mean(axis=0)


def resolve_engine(name: EngineName) -> Backend:
    """Select the engine for this machine: MuJoCo C on a CPU, MuJoCo Warp or MJX on a GPU.

    Warp gives twice the samples per second of MJX. It is untested on several GPUs; they use MJX.
    """
    if name != "auto":
        return name
    if jax.default_backend() == "cpu":
        return "mujoco"
    has_warp = importlib.util.find_spec("warp") is not None
    return "warp" if has_warp and jax.device_count() == 1 else "mjx"
