"""One trial of a policy on the whole robot."""

import math
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from cref_jax import config
from cref_jax.config import Config
from cref_jax.deploy import Policy, Status
from cref_jax.whole_body.disturbances import UNDISTURBED, Channel, Disturbance
from cref_jax.whole_body.simulator import WholeBodySim
from cref_jax.whole_body.termination import TerminationChecker


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


def run_trial(
    body: WholeBodySim,
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
    state = _initial_state(body, start)
    judge, channel = TerminationChecker(body, state, start.speed), Channel(disturbance)
    ending, status, path, speeds = None, Status.OK, [], []
    policy.reset()
    for t in range(round(seconds / period)):
        path.append(state.qpos.copy())
        if come := channel.receive(t):
            status |= policy.on_depth(*come)
        turned = state.xmat[body.robot.pelvis].reshape(3, 3)
        command = lane_command(c.command, start.speed, state.qpos)
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


def lane_command(
    c: config.Command, speed: float, qpos: Float[np.ndarray, " Q"]
) -> Float[np.ndarray, "3"]:
    """Return the command of an operator who keeps the robot on the middle of its lane."""
    w, x, y, z = qpos[3:7]
    heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    wanted = np.clip(-c.lane_gain * qpos[1], -0.5, 0.5)  # rad
    error = (wanted - heading + math.pi) % (2.0 * math.pi) - math.pi
    turn = np.clip(c.heading_gain * error, -c.lane_yaw_rate, c.lane_yaw_rate)
    return np.array([speed, 0.0, turn])


def _initial_state(body: WholeBodySim, start: Start) -> mujoco.MjData:
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
