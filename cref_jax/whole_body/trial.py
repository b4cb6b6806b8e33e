"""One trial of a policy on the whole robot, and the steps it is made of."""

import math
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from cref_jax import config
from cref_jax.config import Config
from cref_jax.deploy import Policy, Status
from cref_jax.whole_body.disturbances import UNDISTURBED, Channel, Disturbance
from cref_jax.whole_body.randomization import Perturbation
from cref_jax.whole_body.simulator import WholeBodySim
from cref_jax.whole_body.termination import TerminationChecker


class Start(NamedTuple):
    """The initial pose and command of a trial."""

    base: Float[np.ndarray, "7"]  # m, quaternion w, x, y, z
    q: Float[np.ndarray, " J"]  # rad, of the joints driven by the policy
    speed: float  # m/s forward, commanded


class Trial(NamedTuple):
    """The outcome of a trial."""

    ending: str  # tilted, low, hit, dropped, unstable, strayed, finished, stalled, late
    seconds: float
    progress: float  # m along the lane
    speed: float  # m/s forward in the body frame, mean
    status: Status  # union of the policy's status over all steps and frames
    qpos: Float[np.ndarray, "T Q"]  # before each control step


class Episode:
    """A policy driving the whole robot, control step by control step."""

    def __init__(
        self,
        body: WholeBodySim,
        policy: Policy,
        start: Start,
        disturbance: Disturbance = UNDISTURBED,
        perturbation: Perturbation | None = None,
    ) -> None:
        """Place the robot and reset the policy.

        Args:
            body: the model.
            policy: as loaded by deploy.py.
            start: initial pose and command.
            disturbance: camera faults.
            perturbation: sensor noise and pushes.
        """
        self.body, self.policy, self.start = body, policy, start
        self.state = _initial_state(body, start)
        self.steps = 0  # done
        self.status = Status.OK  # union of the policy's status over all steps and frames
        self.command = np.array([start.speed, 0.0, 0.0])  # of the last step
        self.speed = 0.0  # m/s forward in the body frame
        self.force = np.zeros((2, 3))  # N, of the ground on each foot, mean over the last step
        self.frame: Float[np.ndarray, "H W"] | None = None  # m, the newest that was delivered
        self._latency, self._perturbation = disturbance.latency, perturbation
        self._checker = TerminationChecker(body, self.state, start.speed)
        self._channel = Channel(disturbance, body.config.camera.view)
        self._before = body.robot.nominal_pose[body.driven]
        policy.reset()

    def step(self, command: Float[np.ndarray, "3"] | None = None) -> str | None:
        """Advance one control step; return the first reason to end, or None.

        Without a command, an operator keeps the robot in the middle of its lane at the start's
        speed.
        """
        body, policy, state, t = self.body, self.policy, self.state, self.steps
        c, now = body.config, t * body.config.physics.control_period
        if delivered := self._channel.receive(t):
            self.frame = delivered[0]
            self.status |= policy.on_depth(*delivered)
        rotation = state.xmat[body.robot.pelvis].reshape(3, 3)
        if command is None:
            command = lane_command(c.command, self.start.speed, state.qpos)
        if self._perturbation:
            self._perturbation.push(state, body.robot.mass, body.hands)
        gyro, gravity, q, qd = _sense(body, state, self._perturbation)
        target = policy.step(gyro, gravity, command, q, qd, now)
        self.status |= policy.status
        due = not policy.blind and _is_due(t + self._latency, c)
        if due and not self._channel.loses_one():
            self._channel.send(body.image(state), t, now)
        self.force = body.advance(state, (self._before, target))
        self._before, self.command, self.steps = target, command, t + 1
        self.speed = float(rotation[:, 0] @ state.qvel[:3])
        return self._checker.check(state, self.force)


def run_trial(
    body: WholeBodySim,
    policy: Policy,
    start: Start,
    seconds: float,
    disturbance: Disturbance = UNDISTURBED,
    perturbation: Perturbation | None = None,
) -> Trial:
    """Run one episode until the robot falls, finishes, strays or stalls, or `seconds` are over."""
    episode = Episode(body, policy, start, disturbance, perturbation)
    ending, path, speeds = None, [], []
    period = body.config.physics.control_period
    for _ in range(round(seconds / period)):
        path.append(episode.state.qpos.copy())
        ending = episode.step()
        speeds.append(episode.speed)
        if ending:
            break
    return Trial(
        ending=ending or "late",
        seconds=len(path) * period,
        progress=float(episode.state.qpos[0] - start.base[0]),
        speed=float(np.mean(speeds)),
        status=episode.status,
        qpos=np.stack(path),
    )


def lane_command(
    c: config.Command, speed: float, qpos: Float[np.ndarray, " Q"]
) -> Float[np.ndarray, "3"]:
    """Compute the command of an operator who keeps the robot in the middle of its lane."""
    w, x, y, z = qpos[3:7]
    heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    wanted = np.clip(-c.lane_gain * qpos[1], -0.5, 0.5)  # rad
    error = (wanted - heading + math.pi) % (2.0 * math.pi) - math.pi
    turn = np.clip(c.heading_gain * error, -c.lane_yaw_rate, c.lane_yaw_rate)
    return np.array([speed, 0.0, turn])


def _initial_state(body: WholeBodySim, start: Start) -> mujoco.MjData:
    """Create the initial state, with the upper body in its default pose."""
    state = mujoco.MjData(body.model)
    joints = body.robot.nominal_pose.astype(float)
    joints[body.driven] = start.q
    state.qpos[:] = np.concatenate([start.base, joints])
    state.ctrl[:] = body.robot.nominal_pose
    mujoco.mj_forward(body.model, state)
    return state


def _sense(
    body: WholeBodySim, state: mujoco.MjData, perturbation: Perturbation | None
) -> list[np.ndarray]:
    """Measure angular velocity, gravity, and positions and velocities of the driven joints."""
    rotation = state.xmat[body.robot.pelvis].reshape(3, 3)
    q, qd = state.qpos[7:][body.driven], state.qvel[6:][body.driven]
    clean = [state.qvel[3:6], -rotation[2], q + body.deviation.offset, qd]
    return perturbation.measure(*clean) if perturbation else clean


def _is_due(step: int, c: Config) -> bool:
    """Check whether a frame is due at this control step, as depth.is_due does."""
    frames = c.camera.rate * c.physics.control_period
    return step > 0 and math.floor(step * frames + 1e-9) > math.floor((step - 1) * frames + 1e-9)
