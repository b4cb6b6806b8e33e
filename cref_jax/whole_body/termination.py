"""Termination of a trial: the rules of training, straying and stalling."""

import collections
import math

import mujoco
import numpy as np
from jaxtyping import Float

from cref_jax.env import stall
from cref_jax.whole_body.simulator import WholeBodySim


class TerminationChecker:
    """Checks the rules of training (env.terminations), straying and stalling."""

    def __init__(self, body: WholeBodySim, state: mujoco.MjData, speed: float = 0.0) -> None:
        """Start from the first state; `speed` is the command, m/s."""
        self._body, self._c, self._speed = body, body.config, speed
        self._period = body.config.physics.control_period
        self._x = collections.deque(
            [float(state.qpos[0])], round(stall.STALL_SECONDS / self._period) + 1
        )
        self._support = state.qpos[2] - body.config.reward.base_height_target

    def check(self, state: mujoco.MjData, force: Float[np.ndarray, "2 3"]) -> str | None:
        """Find the first reason to end, or None; call after every control step."""
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
        """Record x, m, and check whether the robot has stalled."""
        self._x.append(x)
        return stall.stalled_at(np.array(self._x), self._speed, self._period) is not None
