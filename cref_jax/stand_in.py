"""The robot's stand-in: all 31 joints in MuJoCo C on real boxes, driven by an exported policy.

It knows nothing of the training simulation: the ground is solids and not tangent planes, depth
comes from MuJoCo's own ray-cast, the upper body is held by its motors, and the policy is run by
deploy.py on what a robot measures. Nothing of JAX is in its loop.
"""

import collections
import math
from typing import NamedTuple, Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Float

from cref_jax import config, geoms, robot
from cref_jax.config import Config
from cref_jax.deploy import Policy, Status
from cref_jax.disturbance import UNDISTURBED, Channel, Disturbance
from cref_jax.env import stall
from cref_jax.errors import ConfigError

MOST_BOXES = 20_000
MARGIN = 4.0  # m around the lane where its border goes on, as in training; further than is seen
FAR = 1e3  # m, a ray that meets nothing
GROUND, SEEN, UNSEEN = 0, 1, 2  # geom groups; rays meet the first two


@runtime_checkable
class Ground(Protocol):
    """What a trial is walked on.

    The ground always meets soles and shanks, and the links that are kept clear. Where
    `stops_every_link`, it meets arms, knees and the capsules of the feet as well: a hand is stopped
    by a rail, which is no fall, and a foot stands across slots that its spheres would sink into.
    Pelvis, torso, head and thighs end the trial wherever they touch. On a lane there is nothing
    beside the robot, and contact is as in training, by spheres alone. On level ground the two are
    the same: spheres and capsules of a foot end at one height.
    """

    @property
    def end(self) -> float:
        """Return where along x a trial is won, m; infinite on open ground."""
        ...

    @property
    def width(self) -> float:
        """Return how wide the path is, m; it lies on both sides of y = 0."""
        ...

    @property
    def stops_every_link(self) -> bool:
        """Return whether all links of the robot are solid to it."""
        ...

    def add_to(self, spec: mujoco.MjSpec, friction: float) -> None:
        """Add its geoms to a model, in the group GROUND."""
        ...


class Lane(NamedTuple):
    """A lane of columns, as in training."""

    heights: Float[np.ndarray, "X Y"]  # m, of the columns
    origin: Float[np.ndarray, "2"]  # m, outer corner of the first column
    cell: float  # m
    end: float  # m along x where a trial is won; infinite on open ground
    width: float = math.inf  # m
    stops_every_link: bool = False

    def add_to(self, spec: mujoco.MjSpec, friction: float) -> None:
        """Add boxes, and a border around them.

        Raises:
            ConfigError: they are too many.
        """
        around = math.ceil(MARGIN / self.cell)
        heights = np.pad(self.heights, around, mode="edge")
        origin = self.origin - around * self.cell
        found = geoms.boxes(heights, max(heights.shape), MOST_BOXES)
        if found is None:
            raise ConfigError(f"this ground needs more than {MOST_BOXES} boxes")
        bottom = float(self.heights.min()) - 0.1  # m
        for first, size, height in zip(found.first, found.size, found.height, strict=True):
            half = 0.5 * (height - bottom)
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[*(origin + (first + 0.5 * size) * self.cell), height - half],
                size=[*(0.5 * size * self.cell), half],
                friction=[friction, 0.005, 0.0001],
                contype=0,
                conaffinity=1,
                group=GROUND,
            )


class Start(NamedTuple):
    """How a trial begins."""

    base: Float[np.ndarray, "7"]  # m, quaternion w, x, y, z
    q: Float[np.ndarray, " J"]  # rad, of the joints that the policy drives
    speed: float  # m/s forward, commanded


class Trial(NamedTuple):
    """What became of it."""

    ending: str  # tilted, low, hit, dropped, unstable, strayed, finished, stalled, late
    seconds: float
    progress: float  # m along the lane
    speed: float  # m/s forward in the body frame, mean
    status: Status  # everything that the policy has ever said was wrong
    qpos: Float[np.ndarray, "T Q"]  # before each control step


class StandIn:
    """The compiled model of robot and ground, and where things are in it."""

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
            ground: what to walk on.
            joints: those that the policy drives, in its order.
            friction: coefficient that acts between robot and ground. MuJoCo takes the larger one
                of two geoms, so that both have it.

        Raises:
            ConfigError: the ground needs too many boxes.
        """
        self.config, self.ground = c, ground
        self.robot = robot.load(config.Robot(actuated="all"))
        self.model = model = _spec(c, ground, self.robot, friction).compile()
        names = self.robot.joint_names
        self.driven = np.array([names.index(name) for name in joints])
        self.feet = [model.body(f"{side}_ankle_roll_link").id for side in ("left", "right")]
        self.rays = _rays(c.camera)
        clear = np.array(self.robot.capsules.names)[self.robot.capsules.kept_clear]
        self.kept_clear = {model.geom(name).id for name in clear}

    def image(self, state: mujoco.MjData) -> Float[np.ndarray, "H W"]:
        """Return z-depth in metres by ray-cast, infinity where a ray meets nothing."""
        mount, camera = self.robot.camera, self.config.camera
        link = state.xmat[mount.body].reshape(3, 3)
        fixed = np.zeros(9)
        mujoco.mju_quat2Mat(fixed, mount.rotation.astype(float))
        pitch = math.radians(camera.pitch)
        c, s = math.cos(pitch), math.sin(pitch)
        axes = np.array([[0.0, -s, c], [-1.0, 0.0, 0.0], [0.0, -c, -s]])  # right, down, forward
        position = state.xpos[mount.body] + link @ mount.position
        world = self.rays @ (link @ fixed.reshape(3, 3) @ axes).T
        count = len(world)
        found, distance = np.zeros(count, np.int32), np.zeros(count)
        groups = np.array([g in (GROUND, SEEN) for g in range(6)], np.uint8)
        mujoco.mj_multiRay(
            self.model, state, position, world.ravel(), groups, True, -1, found, distance,
            None, count, FAR,
        )  # fmt: skip
        depth = np.where(distance < 0.0, np.inf, distance * self.rays[:, 2])
        return depth.reshape(camera.shape).astype(np.float32)

    def advance(self, state: mujoco.MjData) -> Float[np.ndarray, "2 3"]:
        """Advance one control step; return the mean force on each foot, N, as in training."""
        substeps, force = self.config.physics.substeps, np.zeros((2, 3))
        for _ in range(substeps):
            mujoco.mj_step(self.model, state)
            force += self.foot_force(state) / substeps
        mujoco.mj_forward(self.model, state)  # poses and contacts of this moment, not of the last
        return force

    def foot_force(self, state: mujoco.MjData) -> Float[np.ndarray, "2 3"]:
        """Return the force of the ground on each foot at the last evaluation, N."""
        return -state.sensordata.reshape(2, 3)

    def is_hit(self, state: mujoco.MjData) -> bool:
        """Return whether a part that is kept clear has come down."""
        return not self.kept_clear.isdisjoint(state.contact.geom.ravel())


class _Judge:
    """Says how a trial ends: by the rules of training (episode.ending), astray, or stalled."""

    def __init__(self, body: StandIn, state: mujoco.MjData, speed: float = 0.0) -> None:
        """Begin with the first state; `speed` is the command, m/s."""
        self._body, self._c, self._speed = body, body.config, speed
        self._period = body.config.physics.control_period
        self._x = collections.deque(
            [float(state.qpos[0])], round(stall.STALL_SECONDS / self._period) + 1
        )
        self._support = state.qpos[2] - body.config.reward.base_height_target

    def ending(self, state: mujoco.MjData, force: Float[np.ndarray, "2 3"]) -> str | None:
        """Return the first reason to end, or None; to be asked after every control step."""
        c, episode, body = self._c, self._c.episode, self._body
        if any(warning.number for warning in state.warning):
            return "unstable"
        foot_z = state.xpos[body.feet, 2]
        on_ground = np.linalg.norm(force, axis=1) > c.reward.contact_force
        bearing = force[:, 2] > c.reward.support_force
        if on_ground.any():
            self._support = float(foot_z[bearing].mean() if bearing.any() else foot_z.min())
        x, y, z = state.qpos[:3]
        upright = state.xmat[body.robot.pelvis].reshape(3, 3)[2, 2]
        reasons = {
            "tilted": upright < math.cos(episode.max_tilt),
            "low": z - self._support < episode.min_height,
            "hit": body.is_hit(state),
            "dropped": foot_z.min() < self._support - episode.below_edge,
            "strayed": abs(y) > 0.5 * body.ground.width,
            "finished": x > body.ground.end,
            "stalled": self._has_stalled(float(x)),
        }
        return next((name for name, is_so in reasons.items() if is_so), None)

    def _has_stalled(self, x: float) -> bool:
        """Return whether the robot has stalled now that it is at x, m."""
        self._x.append(x)
        return stall.stalled_at(np.array(self._x), self._speed, self._period) is not None


def run(
    body: StandIn,
    policy: Policy,
    start: Start,
    seconds: float,
    disturbance: Disturbance = UNDISTURBED,
) -> Trial:
    """Let the policy walk once, until it falls, is through, or has stalled.

    Args:
        body: the model.
        policy: as deploy.py loads it; it is reset.
        start: pose and command.
        seconds: at most.
        disturbance: what happens to the frames on their way from the camera.
    """
    c, period, latency = body.config, body.config.physics.control_period, disturbance.latency
    state = _placed(body, start)
    judge, channel = _Judge(body, state, start.speed), Channel(disturbance)
    ending, status, path, speeds = None, Status.OK, [], []
    policy.reset()
    for t in range(round(seconds / period)):
        path.append(state.qpos.copy())
        if come := channel.receive(t):
            status |= policy.on_depth(*come)
        turned = state.xmat[body.robot.pelvis].reshape(3, 3)
        command = steered(c.command, start.speed, state.qpos)
        q, qd = state.qpos[7:][body.driven], state.qvel[6:][body.driven]
        target = policy.step(state.qvel[3:6], -turned[2], command, q, qd, t * period)
        status |= policy.status
        if not policy.blind and _is_due(t + latency, c) and not channel.loses_one():
            channel.send(body.image(state), t, t * period)
        state.ctrl[body.driven] = target
        force = body.advance(state)
        speeds.append(float(turned[:, 0] @ state.qvel[:3]))
        ending = judge.ending(state, force)
        if ending:
            break
    return Trial(
        ending=ending or "late",
        seconds=len(path) * period,
        progress=float(state.qpos[0] - start.base[0]),
        speed=float(np.mean(speeds)),
        status=status,
        qpos=np.stack(path),
    )


def steered(
    c: config.Command, speed: float, qpos: Float[np.ndarray, " Q"]
) -> Float[np.ndarray, "3"]:
    """Return the command of an operator who keeps the robot on the middle of its lane."""
    w, x, y, z = qpos[3:7]
    heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    wanted = np.clip(-c.lane_gain * qpos[1], -0.5, 0.5)  # rad
    error = (wanted - heading + math.pi) % (2.0 * math.pi) - math.pi
    turn = np.clip(c.heading_gain * error, -c.lane_yaw_rate, c.lane_yaw_rate)
    return np.array([speed, 0.0, turn])


def _placed(body: StandIn, start: Start) -> mujoco.MjData:
    """Return the state at the start, the upper body at its default."""
    state = mujoco.MjData(body.model)
    joints = body.robot.nominal_pose.astype(float)
    joints[body.driven] = start.q
    state.qpos[:] = np.concatenate([start.base, joints])
    state.ctrl[:] = body.robot.nominal_pose
    mujoco.mj_forward(body.model, state)
    return state


def _is_due(step: int, c: Config) -> bool:
    """Return whether a frame arrives at this control step: see depth.is_due."""
    frames = c.camera.rate * c.physics.control_period
    return step > 0 and math.floor(step * frames + 1e-9) > math.floor((step - 1) * frames + 1e-9)


def _rays(camera: config.Camera) -> Float[np.ndarray, "n 3"]:
    """Return unit vectors through the pixels' middles: right, down, forward."""
    rows, columns = camera.shape
    down, right = (math.tan(math.radians(0.5 * angle)) for angle in camera.view)
    at = lambda n, reach: reach * ((2.0 * np.arange(n) + 1.0) / n - 1.0)
    y, x = np.meshgrid(at(rows, down), at(columns, right), indexing="ij")
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _spec(c: Config, ground: Ground, whole: robot.Robot, friction: float) -> mujoco.MjSpec:
    """Return robot and ground; rays meet the ground and the links that training renders."""
    spec = robot.spec("all", c.physics, contact_planes=0, visual=True)
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
    robot.add_force_sensors(spec)
    return spec
