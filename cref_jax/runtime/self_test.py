"""The replay of test vectors, and how long a step takes."""

from __future__ import annotations

import os
import sys
import time

import numpy as np

from cref_jax.runtime.files import (
    one_error,
    parse_arrays,
    read_file,
    read_manifest,
    read_verified,
)
from cref_jax.runtime.policy import TERMS, Policy, load
from cref_jax.runtime.status import FAULTS, Status
from cref_jax.runtime.tables import PolicyFormatError

TOLERANCE = 1e-5  # of the self-test: norm of a tensor's error relative to the tensor's norm


def self_test(path: str | os.PathLike[str], rounds: int = 20) -> dict[str, np.ndarray]:
    """Replay the test vectors; return the durations of steps, s, with and without a frame.

    Raises:
        PolicyFormatError: it cannot be loaded, or its outputs differ from the training network's.
    """
    with one_error(path):
        policy = load(path, careful=False)
        manifest = read_manifest(read_file(path, "manifest.json"))
        if "cref_runtime.py" in manifest["files"]:  # one within the package uses the package's own
            read_verified(path, "cref_runtime.py", manifest)
        vectors = parse_arrays(read_verified(path, "testvectors.npz", manifest))
        errors: dict[str, float] = {}
        steps = [_replay(policy, vectors, errors) for _ in range(rounds)]
        name = max(errors, key=lambda n: errors[n])
        if not errors[name] <= TOLERANCE:
            raise PolicyFormatError(f"'{name}' differs from training's by {errors[name]:.1e}")
    seconds, frames = np.concatenate(steps).T
    times = {"a frame and a step": seconds[frames > 0], "a step": seconds[frames == 0]}
    return {name: durations for name, durations in times.items() if len(durations)}


def _replay(policy: Policy, vectors: dict[str, np.ndarray], errors: dict[str, float]) -> np.ndarray:
    """Replay once; return seconds and frames of each step [T, 2], update the largest `errors`."""
    inputs = [vectors[name] for name in (*TERMS[:3], "q", "qd", "now")]
    expected = {k[7:]: v for k, v in vectors.items() if k.startswith("expect/")}
    scales = {k: float(np.linalg.norm(v)) / len(v) ** 0.5 + 1e-9 for k, v in expected.items()}
    steps = np.zeros((len(vectors["now"]), 2))
    for t in range(len(steps)):
        if vectors["reset"][t]:
            policy.reset()
        frames = np.flatnonzero(vectors["frame_step"] == t)
        started_at = time.perf_counter()
        for k in frames:
            policy.on_depth(vectors["frames"][k], vectors["stamps"][k])
        target = policy.step(*(x[t] for x in inputs))
        steps[t] = time.perf_counter() - started_at, len(frames)
        if policy.status & (FAULTS | Status.HOLDING | Status.DAMPING):
            raise PolicyFormatError(f"step {t} of the test vectors: {policy.status!r}")
        tensors = {**policy.tensors(), "target": target}
        for name in expected:
            error = float(np.linalg.norm(tensors[name] - expected[name][t])) / scales[name]
            errors[name] = max(errors.get(name, 0.0), error if np.isfinite(error) else np.inf)
    return steps


def report(times: dict[str, np.ndarray]) -> list[str]:
    """Format the latencies measured by `self_test` as lines of text, with the versions."""
    of = lambda seconds: 1e3 * np.percentile(seconds, (50, 99, 100))
    text = "{}: p50 {:.2f} ms, p99 {:.2f} ms, max {:.2f} ms"
    versions = f"Python {sys.version.split()[0]}, numpy {np.__version__}"
    return [versions, *(text.format(name, *of(seconds)) for name, seconds in times.items())]
