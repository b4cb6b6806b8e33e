"""A robot in a process of its own, with a watchdog: `robot_process.py POLICY ADDRESS SECONDS`."""

import json
import sys
from multiprocessing.connection import Listener
from pathlib import Path

import numpy as np
from integrator import Harness

from cref_jax.robot.registry import describe

WATCHDOG = 2.0  # s of real time without a target; simulated steps have no real rate


class Remote:
    """The policy on the other end of a socket."""

    def __init__(self, link) -> None:
        self._link, self._frame, self.lost = link, (None, None), False

    def on_depth(self, frame, stamp) -> None:
        self._frame = frame, stamp

    def step(self, gyro, gravity, command, q, qd, now) -> np.ndarray:
        """Ask for a target; without an answer in time, damp at the measured pose."""
        (frame, stamp), self._frame = self._frame, (None, None)
        if self.lost:
            return q
        state = {"gyro": gyro, "gravity": gravity, "command": command, "q": q, "qd": qd}
        state |= {"now": now, "commanded": now, "frame": frame, "stamp": stamp}
        try:
            self._link.send(state)
            if self._link.poll(WATCHDOG):
                return self._link.recv()
        except (OSError, EOFError):
            pass
        self.lost = True
        return q


def main() -> None:
    """Stand for a second and walk; print how it ended as JSON."""
    policy, address, seconds = Path(sys.argv[1]), sys.argv[2], float(sys.argv[3])
    robot = Harness(policy, describe("x2_ultra").xml, 0)
    with Listener(address) as listener, listener.accept() as link:
        link.send([joint["name"] for joint in robot.manifest["joints"]])
        robot.policy = Remote(link)
        upright = robot.run(seconds, 0.5)
        ended = {"upright": upright, "x": float(robot.data.qpos[0]), "lost": robot.policy.lost}
        if not robot.policy.lost:
            link.send(None)
    print(json.dumps(ended))


if __name__ == "__main__":
    main()
