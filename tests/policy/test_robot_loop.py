"""The example of a robot's program drives the whole robot, which is in a process of its own."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cref_jax.policy import sources, writer

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    directory = tmp_path_factory.mktemp("exported") / "policy"
    writer.copy(sources.bundled_policy("robust"), directory)
    return directory


def start(exported, tmp_path, seconds):
    """Start the robot and its program; return both processes."""
    address = str(tmp_path / "robot")
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    spawn = lambda script, *more: subprocess.Popen(
        [sys.executable, str(ROOT / script), str(exported), address, *more],
        cwd=tmp_path, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    robot = spawn("tests/support/robot_process.py", seconds)
    while not Path(address).exists():
        assert robot.poll() is None, robot.stderr.read()
        time.sleep(0.05)
    return robot, spawn("examples/robot_loop.py")


@pytest.mark.slow
def test_the_example_walks_and_ends_with_the_robot(exported, tmp_path):
    robot, program = start(exported, tmp_path, "6")
    said, errors = program.communicate(timeout=120)
    ended = json.loads(robot.communicate(timeout=60)[0])
    assert program.returncode == 0, errors
    assert ended["upright"] and not ended["lost"] and ended["x"] > 1.5
    assert said.splitlines()[-1].endswith("all is right")


@pytest.mark.slow
def test_a_program_that_hangs_is_noticed_by_the_watchdog(exported, tmp_path):
    robot, program = start(exported, tmp_path, "20")
    program.stdout.readline()  # the first status: it runs
    program.send_signal(signal.SIGSTOP)
    try:
        ended = json.loads(robot.communicate(timeout=120)[0])
    finally:
        program.kill()
        program.communicate()
    assert ended["lost"]
