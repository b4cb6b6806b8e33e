"""The control loop of a robot: `python robot_loop.py POLICY ADDRESS`. Replace `Robot` by your own.

The robot itself must have a watchdog: without a target for 0.1 s it damps.
"""

import sys
from multiprocessing.connection import Client

POLICY, ADDRESS = sys.argv[1:]
sys.path.insert(0, POLICY)
import cref_runtime  # noqa: E402
from cref_runtime import Status  # noqa: E402


class Robot:
    """A robot on the other end of a socket, as the whole-robot simulation of the tests is."""

    def __init__(self, address):
        self.link = Client(address)
        self.joint_names = self.link.recv()

    def read(self):
        """Wait for the next control period; None when the robot is switched off."""
        return self.link.recv()

    def send(self, target):
        """Set the targets of the joints, rad."""
        self.link.send(target)


robot = Robot(ADDRESS)
policy = cref_runtime.load(POLICY, joints=robot.joint_names)
said = ""
while (state := robot.read()) is not None:
    if state["frame"] is not None:
        policy.on_depth(state["frame"], state["stamp"])
    gyro, gravity, q, qd = (state[name] for name in ("gyro", "gravity", "q", "qd"))
    target = policy.step(gyro, gravity, state["command"], q, qd, state["now"], state["commanded"])
    robot.send(target)
    if policy.why != said:
        said = policy.why
        print(f"{state['now']:.2f} s  {said or 'all is right'}", flush=True)
    if policy.status & Status.DAMPING:
        policy.recorder.write("last.npz")
        sys.exit(f"damping: {said}; see last.npz")
