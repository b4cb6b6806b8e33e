"""Domain randomisation of the whole robot: what training draws (env.randomization), in numpy."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from cref_jax.config import Config

HOLD_SECONDS = 0.1  # assumed: a wrist slides off a rail within five control steps


class Deviation(NamedTuple):
    """How a robot differs from the nominal one; the default does not. J driven joints."""

    friction: float | None = None  # sliding coefficient; None: as the scene was built
    payload: float = 0.0  # kg on the torso
    com_shift: Float[np.ndarray, "3"] = np.zeros(3)  # m, of the torso's centre of mass
    kp: Float[np.ndarray, " J"] | float = 1.0  # factor
    kd: Float[np.ndarray, " J"] | float = 1.0  # factor
    offset: Float[np.ndarray, " J"] | float = 0.0  # rad, encoder reading less angle
    delay: int = 0  # physics substeps until the motors get a target
    camera_pitch: float = 0.0  # rad
    camera_shift: Float[np.ndarray, "3"] = np.zeros(3)  # m, along the mount's axes


def sample_deviation(c: Config, joints: int, rng: np.random.Generator) -> Deviation:
    """Sample a robot with the ranges of training."""
    r, pitch = c.randomisation, np.deg2rad(c.randomisation.camera_pitch)
    about_zero = lambda width, size=None: rng.uniform(-width, width, size)
    return Deviation(
        friction=rng.uniform(*r.friction),
        payload=about_zero(r.trunk_mass),
        com_shift=about_zero(r.trunk_com, 3),
        kp=rng.uniform(*r.gains, joints),
        kd=rng.uniform(*r.gains, joints),
        offset=about_zero(r.joint_offset, joints),
        delay=int(rng.integers(round(r.action_delay / c.physics.timestep), endpoint=True)),
        camera_pitch=about_zero(pitch),
        camera_shift=about_zero(r.camera_position, 3),
    )


class Perturbation:
    """Sensor noise and pushes of one trial."""

    def __init__(self, c: Config, rng: np.random.Generator) -> None:
        """Plan the first push."""
        self._c, self._period, self._rng = c.randomisation, c.physics.control_period, rng
        self._until_push = self._sample_wait()
        self._hold = _Hold(0, 0, np.zeros(3))

    def measure(self, *clean: np.ndarray) -> list[np.ndarray]:
        """Add noise to angular velocity, gravity, joint positions and joint velocities."""
        c = self._c
        widths = (
            c.noise_angular_velocity, c.noise_gravity,
            c.noise_joint_position, c.noise_joint_velocity,
        )  # fmt: skip
        pairs = zip(clean, widths, strict=True)
        return [x + self._rng.uniform(-width, width, x.shape) for x, width in pairs]

    def push(self, state: mujoco.MjData, mass: float, hands: Sequence[int]) -> None:
        """Change the base's velocity, or hold one of the bodies `hands`, when a push is due.

        Call before every control step. A hand is held, as by a rail, with the force that takes half
        of a push from the whole robot, of `mass` kg.
        """
        steps, body, force = self._hold
        state.xfrc_applied[:, :3] = 0.0
        if steps:
            state.xfrc_applied[body, :3] = force
            self._hold = _Hold(steps - 1, body, force)
        self._until_push -= 1
        if self._until_push > 0:
            return
        self._until_push, most = self._sample_wait(), self._c.push_velocity
        shove = self._rng.uniform(-most, most, 2)
        if self._rng.random() < 0.5:
            state.qvel[:2] += shove
            return
        steps = round(HOLD_SECONDS / self._period)
        force = np.append(0.5 * mass * shove / (steps * self._period), 0.0)
        self._hold = _Hold(steps, int(self._rng.choice(list(hands))), force)

    def _sample_wait(self) -> int:
        low, high = (round(t / self._period) for t in self._c.push_period)
        return int(self._rng.integers(low, high, endpoint=True))


class _Hold(NamedTuple):
    """A hand that is held."""

    steps: int  # control steps left
    body: int
    force: Float[np.ndarray, "3"]  # N, world
