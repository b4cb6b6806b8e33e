"""Several processes train one policy, lose one, and what is left goes on."""

import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import orbax.checkpoint as ocp
import pytest

pytestmark = pytest.mark.slow

COMPARED = 2  # iterations, of six updates each; later ones differ as soon as one contact does
SMALL = shlex.split("""
    --device cpu --no-tensorboard --no-evaluate --terrain gap --experiment smoke --num-envs 16
    --ppo.horizon 8 --ppo.epochs 3 --camera.shape 24 32 --scan.x -0.2 0.8 3 --scan.y -0.2 0.2 3
    --scan.ahead 0.0 0.6 4 --network.convolutions 2 4 4 4 3 2 --network.token 4
    --network.heads 2 --network.compressed 4 --network.lstm 4 --network.gru 4
    --network.actor 8 --network.critic 8 --run.chunk 1 --run.keep 1000
    --run.checkpoint-minutes 1e-9
""")


class Ended(NamedTuple):
    code: int
    said: str
    seconds: float  # from the other one's death


def begin(*arguments: str, devices: int) -> subprocess.Popen:
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}"
    return subprocess.Popen(
        [sys.executable, "-m", "cref_jax.train", *arguments],
        env={**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def finished(process: subprocess.Popen) -> str:
    said, _ = process.communicate(timeout=600)
    assert process.returncode == 0, said
    return said


def iterations(run: Path) -> int:
    file = run / "log.jsonl"
    return len(file.read_text().splitlines()) if file.exists() else 0


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> tuple[Path, Ended]:
    """Let two processes of two devices train, kill one, and wait for the other."""
    run = tmp_path_factory.mktemp("pair") / "run"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    together = ["--coordinator", address, "--num-processes", "2", "--process-id"]
    every = [*SMALL, "--run-dir", str(run), "--iterations", "100000", *together]
    first, other = (begin(*every, str(k), devices=2) for k in range(2))
    try:
        while iterations(run) < COMPARED + 3:
            assert first.poll() is None and other.poll() is None, first.communicate()[0]
            time.sleep(0.2)
        other.send_signal(signal.SIGKILL)
        died = time.monotonic()
        said, _ = first.communicate(timeout=300)
        return run, Ended(first.returncode, said, time.monotonic() - died)
    finally:
        for process in (first, other):
            process.kill()


def parameters(run: Path, step: int) -> np.ndarray:
    path = (run / "checkpoints" / str(step)).absolute()
    with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as reader:
        state = reader.restore(path, ocp.args.Composite(state=ocp.args.PyTreeRestore())).state
    learned = sorted(name for name in state if name.startswith("train/params"))
    return np.concatenate([np.ravel(state[name]).astype(float) for name in learned])


def test_ten_updates_are_those_of_one_process_with_as_many_devices(pair, tmp_path):
    run, _ = pair
    alone = tmp_path / "run"
    count = ["--iterations", str(COMPARED)]
    finished(begin(*SMALL, "--run-dir", str(alone), *count, devices=4))
    ours, theirs, start = parameters(run, COMPARED), parameters(alone, COMPARED), parameters(run, 1)
    assert np.linalg.norm(ours - theirs) < 1e-5 * np.linalg.norm(theirs)
    assert np.linalg.norm(ours - start) > 1e-3 * np.linalg.norm(theirs)
    rewards = [
        [json.loads(line)["walk/reward"] for line in (folder / "log.jsonl").open()][:COMPARED]
        for folder in (run, alone)
    ]
    np.testing.assert_allclose(*rewards, rtol=1e-4)


def test_one_process_alone_writes_and_talks(pair):
    run, ended = pair
    assert len((run / "origin.jsonl").read_text().splitlines()) == 1
    steps = [json.loads(line)["iteration"] for line in (run / "log.jsonl").open()]
    assert steps == list(range(1, len(steps) + 1))
    assert ended.said.count("compiled in") == 1


def test_a_lost_process_ends_the_other_within_a_minute_and_one_line(pair):
    _, ended = pair
    assert ended.code == 1 and ended.seconds < 60.0
    assert "error: another process of this run was lost" in ended.said
    assert "Traceback" not in ended.said


def test_a_run_moves_to_one_process_and_to_other_numbers_of_devices(pair):
    run, _ = pair
    for devices, before in ((1, 4), (2, 1)):
        done = max(int(p.name) for p in (run / "checkpoints").iterdir() if p.name.isdigit())
        go_on = ["--resume", "--run-dir", str(run), "--iterations", str(done + 1)]
        said = finished(begin(*SMALL, *go_on, devices=devices))
        assert f"shares changes from {before} to {devices}; the robots go on" in said
        assert f"from iteration {done}" in said
        last = json.loads((run / "log.jsonl").read_text().splitlines()[-1])
        assert last["iteration"] == done + 1
        far = np.linalg.norm(parameters(run, done + 1) - parameters(run, done))
        assert 0.0 < far < 0.1 * np.linalg.norm(parameters(run, done))
