"""A policy in C, compiled strictly and with sanitizers, beside the same policy in numpy."""

import io
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from cref_jax import deploy
from cref_jax.deploy import Status
from cref_jax.policy import c_files
from cref_jax.runtime.camera import Camera
from cref_jax.runtime.cross_checks import CrossChecks
from cref_jax.runtime.nudge import Nudge

DRIVER = Path(__file__).parent / "policy_driver.c"
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
CHECKED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
CALLS = (
    "reset", "on_depth", "step", "stop", "on_both_feet", "begin_at_once", "round_to_half", "text",
)  # fmt: skip


def compiler(*names: str) -> str:
    """Return a compiler; skip the test where there is none."""
    for name in names:
        if found := shutil.which(name):
            return found
    pytest.skip(f"no {' or '.join(names)} on this machine")


def write(manifest: dict, arrays: dict, folder: Path) -> Path:
    """Write the policy's C files."""
    folder.mkdir(exist_ok=True, parents=True)
    for name, data in c_files.write_c(manifest, arrays).items():
        (folder / name).write_bytes(data)
    return folder


def build(folder: Path) -> Path:
    """Compile the policy in the folder with the driver; return the program."""
    program = folder / "driver"
    command = [compiler("gcc", "cc"), *STRICT, *CHECKED, f"-I{folder}", str(DRIVER)]
    done = subprocess.run(
        [*command, "-o", str(program), "-lm"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return program


class Calls:
    """Calls of up to two policies, to be answered at once."""

    def __init__(self, joints: int) -> None:
        self._data, self._kinds, self._joints = bytearray(), [], joints

    def add(self, name: str, *values, times: tuple[float, ...] = (), which: int = 0) -> None:
        """Add a call with its values and times."""
        self._data += bytes([CALLS.index(name), which])
        for value in values:
            self._data += np.asarray(value, "<u4" if isinstance(value, int) else "<f4").tobytes()
        self._data += np.asarray(times, "<f8").tobytes()
        self._kinds.append(name)

    def answer(self, program: Path) -> list:
        """Run all calls; return what each returned, None where nothing."""
        done = subprocess.run(
            [str(program)], input=bytes(self._data), capture_output=True, check=False
        )
        assert done.returncode == 0, done.stderr.decode()[-3000:]
        self._said = io.BytesIO(done.stdout)
        answers = [self._parse(kind) for kind in self._kinds]
        assert not self._said.read()
        return answers

    def _parse(self, kind: str):
        if kind == "step":
            status, numbers = self._take("<u4"), self._take("<f4", self._joints + 3)
            return int(status[0]), numbers[: self._joints], numbers[self._joints :]
        if kind == "text":
            return self._said.readline().decode().rstrip()
        if kind == "round_to_half":
            return self._take("<f4", int(self._take("<u4")[0]))
        kinds = {"on_depth": "<u4", "on_both_feet": "?"}
        return self._take(kinds[kind])[0].item() if kind in kinds else None

    def _take(self, dtype: str, count: int = 1) -> np.ndarray:
        numbers = np.frombuffer(self._said.read(count * np.dtype(dtype).itemsize), dtype)
        assert len(numbers) == count
        return numbers


class Both:
    """A policy in numpy that does not compare the senses, and a record of its calls for C."""

    def __init__(
        self,
        manifest,
        arrays,
        calls: Calls,
        which: int = 0,
        at_once: bool = False,
        near: bool = False,
    ):
        self._numpy = deploy.Policy(manifest, arrays)
        self._near = deploy.Policy(manifest, arrays) if near else None
        self.sensitivity = 0.0
        """rad by which a target has changed at most where each joint is at the next float; 0 unless
        `near`"""
        self._calls, self._which, self._at_once = calls, which, at_once
        self.joints, self.blind = self._numpy.joints, self._numpy.blind
        self.reset()

    def _add(self, name: str, *values, times: tuple[float, ...] = ()) -> None:
        self._calls.add(name, *values, times=times, which=self._which)

    def reset(self) -> None:
        """Reset; in C all is as if the policy were new."""
        for policy in filter(None, (self._numpy, self._near)):
            policy.reset()
            policy._senses.q[:] = self.joints.default
            policy._actor._known[:] = 0.0
            policy._begun = policy._begun or self._at_once
        self._add("reset")
        if self._at_once:
            self._add("begin_at_once")

    def stop(self) -> None:
        for policy in filter(None, (self._numpy, self._near)):
            policy.stop()
        self._add("stop")

    def on_depth(self, depth, stamp: float) -> int:
        """Give a frame; return the status of numpy's."""
        self._add("on_depth", depth, times=(stamp,))
        depth = np.asarray(depth, np.float32)
        if self._near:
            self._near.on_depth(depth, stamp)
        return int(self._numpy.on_depth(depth, stamp))

    def step(self, *inputs, now: float, commanded: float) -> tuple[int, np.ndarray, np.ndarray]:
        """Step; return status, target and velocity of numpy's."""
        self._add("step", *inputs, times=(now, commanded))
        *others, q, qd = (np.asarray(x, np.float32) for x in inputs)
        target = self._numpy.step(*others, q, qd, now, commanded)
        if self._near:
            near = self._near.step(*others, np.nextafter(q, np.float32(np.inf)), qd, now, commanded)
            self.sensitivity = max(self.sensitivity, float(np.abs(near - target).max()))
        return int(self._numpy.status), target, self._numpy.tensors()["velocity"]

    @property
    def damping(self) -> bool:
        return bool(self._numpy.status & Status.DAMPING)

    def on_both_feet(self) -> bool:
        self._add("on_both_feet")
        return self._numpy.on_both_feet()


def leave_out_cross_checks(monkeypatch) -> None:
    """Let the runtime in numpy neither compare the senses nor swing the hips, as C does not."""
    compare = CrossChecks.compare

    def count_only(self, *senses, forget=False) -> Status:
        compare(self, *senses, forget=forget)
        return Status.OK

    monkeypatch.setattr(CrossChecks, "compare", count_only)
    monkeypatch.setattr(Nudge, "offset", lambda self: np.float32(0.0))
    monkeypatch.setattr(Nudge, "judge", lambda self: deploy.Status.OK)
    monkeypatch.setattr(Camera, "_compare_tilts", lambda self, seen, gravity: Status.OK)


def assert_equal(answers: list, expected: list, within: float = 1e-5) -> None:
    """Check statuses for equality, and targets (rad) and velocities (m/s) for nearness."""
    assert len(answers) == len(expected)
    for at, (ours, theirs) in enumerate(zip(answers, expected, strict=True)):
        said, right = ((x, [], []) if not isinstance(x, tuple) else x for x in (ours, theirs))
        assert said[0] == right[0], f"call {at}: {Status(said[0])!r}, not {Status(right[0])!r}"
        for x, y in zip(said[1:], right[1:], strict=True):
            np.testing.assert_allclose(x, y, rtol=0.0, atol=within, err_msg=f"call {at}")
