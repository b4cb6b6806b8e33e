"""The whole robot: all joints in MuJoCo C on solid boxes, driven by an exported policy.

It shares nothing with the training simulation: the ground is solids, not tangent planes; depth
comes from MuJoCo's own ray-cast; the upper body is held by its motors; and deploy.py runs the
policy on measured inputs. Its rules duplicate those of training on purpose, as an independent
oracle; tests compare each pair.
"""

import copy
import math
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from cref_jax import config, robot
from cref_jax.config import Config
from cref_jax.robot.registry import describe
from cref_jax.whole_body.ground import GROUND, SEEN, UNSEEN, Ground
from cref_jax.whole_body.randomization import Deviation

FAR = 1e3  # m, length of the rays


class WholeBodySim:
    """The compiled model of robot and ground, with its indices."""

    def __init__(
        self,
        c: Config,
        ground: Ground,
        joints: tuple[str, ...],
        friction: float = robot.FRICTION,
    ) -> None:
        """Compile the model.

        Args:
            c: settings of physics, camera and episodes.
            ground: the ground to walk on.
            joints: the joints driven by the policy, in its order.
            friction: coefficient between robot and ground; set on both, since MuJoCo uses the
                larger one of two geoms.

        Raises:
            ConfigError: the ground needs too many boxes.
        """
        self.config, self.ground = robot.fill_in(c), ground
        self.robot = robot.load(config.Robot(c.robot.name, actuated="all"))
        self.model = model = _build_spec(c, ground, self.robot, friction).compile()
        names = self.robot.joint_names
        self.driven = np.array([names.index(name) for name in joints])
        self.feet = list(self.robot.ankles)
        self.rays = _pixel_rays(c.camera)
        clear = np.array(self.robot.capsules.names)[self.robot.capsules.kept_clear]
        self.kept_clear = {model.geom(name).id for name in clear}
        self.hands = [model.body(name).id for name in describe(c.robot.name).hands]
        self.deviation = Deviation()

    def deviate(self, by: Deviation) -> "WholeBodySim":
        """Build the same simulator with a robot that differs from the nominal one."""
        other = copy.copy(self)
        other.deviation, other.model = by, copy.copy(self.model)
        model, trunk = other.model, self.robot.trunk
        if by.friction is not None:
            model.geom_friction[:, 0] = by.friction
        model.body_mass[trunk] += by.payload
        model.body_ipos[trunk] += by.com_shift
        model.actuator_gainprm[self.driven, 0] *= by.kp
        model.actuator_biasprm[self.driven, 1] *= by.kp
        model.actuator_biasprm[self.driven, 2] *= by.kd
        return other

    def image(self, state: mujoco.MjData) -> Float[np.ndarray, "H W"]:
        """Render z-depth in metres by ray-cast, infinity where a ray hits nothing."""
        mount, camera = self.robot.camera, self.config.camera
        link = state.xmat[mount.body].reshape(3, 3)
        fixed = np.zeros(9)
        mujoco.mju_quat2Mat(fixed, mount.rotation.astype(float))
        pitch = math.radians(camera.pitch) + self.deviation.camera_pitch
        c, s = math.cos(pitch), math.sin(pitch)
        axes = np.array([[0.0, -s, c], [-1.0, 0.0, 0.0], [0.0, -c, -s]])  # right, down, forward
        mounted = mount.position + fixed.reshape(3, 3) @ self.deviation.camera_shift
        position = state.xpos[mount.body] + link @ mounted
        world = self.rays @ (link @ fixed.reshape(3, 3) @ axes).T
        count = len(world)
        geom, distance = np.zeros(count, np.int32), np.zeros(count)
        groups = np.array([g in (GROUND, SEEN) for g in range(6)], np.uint8)
        mujoco.mj_multiRay(
            self.model, state, position, world.ravel(), groups, True, -1, geom, distance,
            None, count, FAR,
        )  # fmt: skip
        depth = np.where(distance < 0.0, np.inf, distance * self.rays[:, 2])
        return depth.reshape(camera.shape).astype(np.float32)

    def advance(
        self, state: mujoco.MjData, targets: Sequence[Float[np.ndarray, " J"]]
    ) -> Float[np.ndarray, "2 3"]:
        """Advance one control step; return the mean force on each foot, N, as in training.

        `targets` are the policy's last one and its new one, rad, which the motors get late.
        """
        substeps, force = self.config.physics.substeps, np.zeros((2, 3))
        for substep in range(substeps):
            target = targets[substep >= self.deviation.delay]
            state.ctrl[self.driven] = target - self.deviation.offset
            mujoco.mj_step(self.model, state)
            force += self.foot_force(state) / substeps
        mujoco.mj_forward(self.model, state)  # update poses and contacts to the new state
        return force

    def foot_force(self, state: mujoco.MjData) -> Float[np.ndarray, "2 3"]:
        """Return the force of the ground on each foot at the last evaluation, N."""
        return -state.sensordata.reshape(2, 3)

    def is_hit(self, state: mujoco.MjData) -> bool:
        """Check whether a geom that is kept clear is in contact."""
        return not self.kept_clear.isdisjoint(state.contact.geom.ravel())


def _pixel_rays(camera: config.Camera) -> Float[np.ndarray, "n 3"]:
    """Compute unit vectors through the pixel centres: right, down, forward."""
    rows, columns = camera.shape
    down, right = (math.tan(math.radians(0.5 * angle)) for angle in camera.view)
    at = lambda n, reach: reach * ((2.0 * np.arange(n) + 1.0) / n - 1.0)
    y, x = np.meshgrid(at(rows, down), at(columns, right), indexing="ij")
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _build_spec(c: Config, ground: Ground, whole: robot.Robot, friction: float) -> mujoco.MjSpec:
    """Build robot and ground; rays hit the ground and the links that training renders."""
    spec = robot.spec("all", c.physics, contact_planes=0, visual=True, name=c.robot.name)
    capsules = whole.capsules
    in_view = {n for n, yes in zip(capsules.names, capsules.in_view, strict=True) if yes}
    clear = {n for n, yes in zip(capsules.names, capsules.kept_clear, strict=True) if yes}
    solid = set(capsules.names) if ground.stops_every_link else clear
    for geom in spec.geoms:
        touches = geom.type == mujoco.mjtGeom.mjGEOM_SPHERE
        geom.group = SEEN if geom.name in in_view else UNSEEN
        geom.contype = int(touches or geom.name in solid)
        geom.friction = [friction, 0.005, 0.0001]
    ground.add_to(spec, friction)
    robot.add_force_sensors(spec, c.robot.name)
    return spec
