"""A robot that moves as a policy tells it, and whose sensors, camera, clock and operator fail."""

import numpy as np

PERIOD = 0.02
FAULTS = {  # probability that it begins in a step; all end after 1 to 15 steps
    "nan": 0.01, "m/s^2": 0.003, "fallen": 0.005, "gyro": 0.01, "qd": 0.01, "q": 0.005,
    "one_q": 0.003, "leans": 0.01, "pause": 0.01, "clock": 0.005, "no_time": 0.005,
    "old_command": 0.01,
    "far_command": 0.02, "no_frame": 0.02, "late_frame": 0.01, "frozen": 0.05, "holes": 0.2,
    "too_many_holes": 0.04, "near": 0.02, "nothing": 0.02, "turned": 0.01, "no_stamp": 0.01,
}  # fmt: skip


def ground(height: float = 0.95, pitch: float = 50.0) -> np.ndarray:
    """Return level ground as the camera of a standing robot sees it, m [48, 64]."""
    down = np.tan(np.radians(29.0)) * ((2 * np.arange(48) + 1) / 48 - 1)
    falls = np.sin(np.radians(pitch)) + down * np.cos(np.radians(pitch))
    return np.broadcast_to((height / falls)[:, None], (48, 64)).astype(np.float32)


class Robot:
    """What a robot measures from step to step."""

    def __init__(self, joints, seed: int) -> None:
        self._rng, self._joints = np.random.default_rng(seed), joints
        self._left = dict.fromkeys(FAULTS, 0)  # steps until a fault ends
        self._calm = 0  # steps until a fault may begin
        self._frame = ground()
        self.q, self.now = joints.default.copy(), 1.0

    def _noise(self, size, scale: float) -> np.ndarray:
        return self._rng.normal(0.0, scale, size).astype(np.float32)

    def stand_up(self) -> None:
        """Stand in the default pose, or in a squat with level feet, with all in order."""
        self._left = dict.fromkeys(FAULTS, 0)
        self.q = self._joints.default.copy()
        self._calm = self._rng.integers(20, 90)
        if self._rng.random() < 0.3:  # at first
            self._left["leans"] = self._left["turned"] = self._rng.integers(0, 20)
        if self._rng.random() < 0.5:
            for side in (0, 6):  # hip and ankle take back what the knee bends
                self.q[side : side + 5] += np.array([-0.5, 0.0, 0.0, 1.0, -0.5], np.float32)

    def pass_time(self) -> None:
        """Go to the next control period; faults begin and end."""
        for name, chance in FAULTS.items():
            if self._left[name] == 1:
                self._calm = self._rng.integers(0, 80)
                self._left["gyro"] += 2 * (name == "q")  # what was before is of no use then
            self._left[name] = max(self._left[name] - 1, 0)
            if not self._calm and self._rng.random() < chance:
                self._left[name] = self._rng.integers(1, 16)
        self._calm = max(self._calm - 1, 0)
        self.now += PERIOD * (3.0 if self._left["pause"] == 1 else 1.0)
        self.now -= 1.0 if self._left["clock"] == 1 else 0.0

    def measure(self) -> tuple[list[np.ndarray], float, float]:
        """Measure angular velocity, gravity, command, q, qd; the time, and that of the command."""
        left, q = self._left, self.q + self._noise(self.q.shape, 2e-3)
        w, qd = self._noise(3, 0.3), self._noise(self.q.shape, 0.2)
        command = self._rng.uniform([0.0, -0.3, -1.0], [1.0, 0.3, 1.0]).astype(np.float32)
        gravity = self._noise(3, 0.02) + np.float32([0.4 if left["leans"] else 0.0, 0.0, -1.0])
        gravity /= np.sqrt(gravity @ gravity)
        if left["gyro"]:
            w[self._rng.integers(3)] = 20.0
        if left["qd"]:
            qd[self._rng.integers(len(qd))] = -80.0
        if left["far_command"]:
            command *= np.float32(3.0)
        if left["fallen"]:
            gravity = np.float32([0.8, 0.0, -0.6]) * np.float32([1.0, 0.0, -1.0])
        if left["m/s^2"]:
            gravity *= self._rng.choice(np.float32([9.81, 0.5]))
        if left["q"]:
            q[self._rng.integers(len(q))] = self._rng.choice([40.0, -40.0])
        if left["one_q"]:
            q[:] = 0.1
        inputs = [w, gravity, command, q, qd]
        if left["nan"]:
            part = inputs[self._rng.integers(5)]
            part[self._rng.integers(len(part))] = self._rng.choice([np.nan, np.inf, -np.inf])
        now = np.nan if left["no_time"] else self.now
        return inputs, now, self.now - (0.4 if left["old_command"] else 0.0)

    def see(self) -> tuple[np.ndarray, float] | None:
        """Return a frame and its time of exposure, if one has come since the step before."""
        left, rng = self._left, self._rng
        if rng.random() > 0.4 or left["no_frame"]:
            return None
        if not left["frozen"]:
            self._frame = self._draw_frame()
        stamp = self.now - PERIOD - (0.15 if left["late_frame"] else 0.0)
        return self._frame, np.inf if left["no_stamp"] else stamp

    def _draw_frame(self) -> np.ndarray:
        left, rng = self._left, self._rng
        frame = ground(rng.uniform(0.8, 1.1), rng.uniform(42.0, 58.0)) + self._noise((48, 64), 0.01)
        frame[rng.random((48, 64)) < 0.01] = np.inf
        if left["turned"]:
            frame = frame[::-1].copy()
        if left["near"]:
            frame[32:] = 0.2
            frame[41:] *= self._rng.choice([1.0, 10.0])  # a band that hides no feet
        if left["nothing"]:
            frame[:] = 5.0
        if left["holes"]:
            top, side = rng.integers(0, 40), rng.integers(0, 50)
            frame[top : top + 8, side : side + 14] = np.nan
            frame[rng.integers(0, 48)] = 0.0
            frame[:, rng.integers(0, 64)] = -1.0
            frame[rng.random((48, 64)) < 0.1] = 0.0
        if left["too_many_holes"]:
            frame[rng.random((48, 64)) < 0.6] = np.nan
        return frame
