"""A robot program as an outsider writes it: manifest, MJCF and runtime, and nothing else of ours.

Torques are computed by its own loop at 400 Hz, sensors have noise and encoders are off by a little.
"""

import json
from pathlib import Path

import mujoco
import numpy as np

from cref_jax import deploy

STEP = 0.0025  # s
PERIOD = 8  # steps per control step, 50 Hz
FRAME = 20  # steps per frame, 20 Hz
PUSH = 0.8  # m/s, up to, every 4 s


class Harness:
    """The robot on level ground."""

    def __init__(self, policy: Path, mjcf: Path, seed: int) -> None:
        self.manifest = json.loads((policy / "manifest.json").read_text())
        self.policy = deploy.load(policy)
        self.rng = np.random.default_rng(seed)
        self.model, self.data = self._build(mjcf)
        driven, held = self.manifest["joints"], self.manifest["held_joints"]
        every = [*driven, *held]
        self.qpos, self.qvel = (
            np.array([self.model.joint(j["name"]).qposadr[0] for j in every]),
            np.array([self.model.joint(j["name"]).dofadr[0] for j in every]),
        )
        number = lambda key: np.array([j[key] for j in every])
        self.kp, self.kd, self.effort = number("kp"), number("kd"), number("effort_nm")
        self.target, self.count = number("default_rad"), len(driven)
        self.offset = self.rng.uniform(-0.02, 0.02, self.count)
        self._stand()
        self.rays = self._rays()

    def _build(self, mjcf: Path) -> tuple[mujoco.MjModel, mujoco.MjData]:
        spec = mujoco.MjSpec.from_file(str(mjcf))
        for motor in list(spec.actuators):
            spec.delete(motor)
        spec.option.timestep = STEP
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[50, 50, 0.1], name="ground")
        for geom in spec.geoms:
            ours = geom.name != "ground" and geom.type != mujoco.mjtGeom.mjGEOM_SPHERE
            geom.contype, geom.conaffinity = (0, 0) if ours else (1, 1)
            geom.friction = [0.9, 0.005, 0.0001]
            geom.group = 0 if geom.name == "ground" else 1
        model = spec.compile()
        return model, mujoco.MjData(model)

    def _stand(self) -> None:
        d, soles = self.data, self.model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
        d.qpos[self.qpos] = self.target
        mujoco.mj_forward(self.model, d)
        d.qpos[2] -= (d.geom_xpos[soles, 2] - self.model.geom_size[soles, 0]).min()
        mujoco.mj_forward(self.model, d)

    def _rays(self) -> np.ndarray:
        depth = self.manifest["depth"]
        view = depth["view_deg"]
        grid = lambda n, angle: np.tan(np.radians(angle / 2)) * ((2 * np.arange(n) + 1) / n - 1)
        down = grid(depth["rows"], view["vertical"])
        right = grid(depth["columns"], view["horizontal"])
        rays = np.stack([np.ones((len(down), len(right))), *np.meshgrid(-right, -down)], axis=-1)
        pitch = np.radians(depth["mount"]["pitch_deg"])
        c, s = np.cos(pitch), np.sin(pitch)
        return rays @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T  # x forward, y left, z up

    def see(self) -> np.ndarray:
        """Compute the depth image: level ground at z = 0 along the optical axis, m."""
        mount = self.manifest["depth"]["mount"]
        link, turn = self.data.body(mount["link"]), np.zeros(9)
        mujoco.mju_quat2Mat(turn, np.array(mount["rotation_wxyz"]))
        z = link.xpos[2] + link.xmat.reshape(3, 3)[2] @ np.array(mount["position_m"])
        fall = self.rays @ (link.xmat.reshape(3, 3) @ turn.reshape(3, 3))[2]
        with np.errstate(divide="ignore"):
            return np.where(fall < 0, -z / fall, np.inf).astype(np.float32)

    def run(self, seconds: float, speed: float) -> bool:
        """Walk, or stand where `speed` is 0, and say whether the robot is upright at the end."""
        d, frame = self.data, None
        for t in range(round(seconds / STEP)):
            if t and t % round(4 / STEP) == 0:
                d.qvel[:2] += self.rng.uniform(-PUSH, PUSH, 2)
            if frame and t >= frame[0]:
                self.policy.on_depth(*frame[1:])
                frame = None
            if t % FRAME == 0:
                frame = (t + PERIOD, self.see(), t * STEP)
            if t % PERIOD == 0:
                self.target[: self.count] = self._control(np.array([speed, 0.0, 0.0]), t * STEP)
            q, qd = d.qpos[self.qpos], d.qvel[self.qvel]
            q[: self.count] += self.offset
            torque = self.kp * (self.target - q) - self.kd * qd
            d.qfrc_applied[self.qvel] = np.clip(torque, -self.effort, self.effort)
            mujoco.mj_step(self.model, d)
        return bool(d.xmat[1].reshape(3, 3)[2, 2] > 0.7 and d.qpos[2] > 0.4)

    def _control(self, command: np.ndarray, now: float) -> np.ndarray:
        """Read the sensors and let the policy choose the joint targets, rad."""
        d, noise = self.data, lambda width, n: self.rng.uniform(-width, width, n)
        gyro = d.qvel[3:6] + noise(0.2, 3)
        gravity = -d.xmat[1].reshape(3, 3)[2] + noise(0.05, 3)
        q = d.qpos[self.qpos[: self.count]] + self.offset + noise(0.01, self.count)
        qd = d.qvel[self.qvel[: self.count]] + noise(1.0, self.count)
        return self.policy.step(gyro, gravity, command, q, qd, now)
