"""What is odd in a recording: of a robot that stands still, or, replayed, of any."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from cref_jax.runtime.files import contents
from cref_jax.runtime.legs import Legs
from cref_jax.runtime.policy import START_AFTER, Policy
from cref_jax.runtime.recorder import INPUTS
from cref_jax.runtime.status import FAULTS, WHY, Status
from cref_jax.runtime.tables import PolicyFormatError, Table

STILL_SECONDS = 5.0
MOST_TILT = 5.0  # deg, of gravity, soles and camera
MOST_BIAS = 0.05  # rad/s, of the gyro
MOST_SPEED = 0.2  # rad/s, of joints, mean
MOST_OFFSET = 0.2  # rad, from the default pose
MOST_JITTER = 0.5  # periods, of 99 % of the steps


def read_recording(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Read what `Policy.recorder.write` wrote.

    Raises:
        PolicyFormatError: it is no recording.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            kept = {name: file[name] for name in file.files}
    except Exception as error:  # numpy raises many kinds on what is no .npz
        raise PolicyFormatError(f"{path}: no recording: {error}") from None
    missing = {*INPUTS, "frames", "stamps", "frame_step", "depth_scale"} - set(kept)
    if missing or not len(kept["now"]):
        raise PolicyFormatError(f"{path}: no recording: no {min(missing, default='steps')}")
    return kept


def replay(
    policy: str | os.PathLike[str], recording: str | os.PathLike[str]
) -> tuple[list[str], float]:
    """Give a recording to a policy again; return when which status began, and the largest change.

    The change is that of a target, rad; it is 0 if no step and no frame was lost.
    """
    kept = read_recording(recording)
    careful, start_after = bool(kept.get("careful", True)), kept.get("start_after", START_AFTER)
    runtime = Policy(*contents(policy), float(kept["depth_scale"]), careful, float(start_after))
    told_to_stop = kept.get("told_to_stop", np.zeros(len(kept["now"]), bool))
    lines, before, largest = [], Status.OK, 0.0
    for t in range(len(kept["now"])):
        for k in np.flatnonzero(kept["frame_step"] == t):
            runtime.on_depth(kept["frames"][k], kept["stamps"][k])
        if told_to_stop[t]:
            runtime.stop()
        target = runtime.step(*(kept[name][t] for name in INPUTS))
        if "target" in kept and kept["target"].shape[1:] == target.shape:
            largest = max(largest, float(np.abs(target - kept["target"][t]).max()))
        for flag, words in WHY.items():
            if flag & runtime.status & ~before:
                lines.append(f"{kept['now'][t] - kept['now'][0]:7.2f} s  {flag.name}: {words}")
        before = runtime.status
    return lines, largest


def check(policy: str | os.PathLike[str], recording: str | os.PathLike[str]) -> list[str]:
    """List what is odd in a recording of a robot that stood still in its default pose for 5 s."""
    manifest, arrays = contents(policy)
    root, kept = Table(manifest, "manifest"), read_recording(recording)
    runtime = Policy(manifest, arrays)
    unusable = [*_check_inputs(kept, len(runtime.joints.names))]
    refused = [*_check_status(kept)]
    if unusable:
        return unusable + refused
    seconds = float(kept["now"][-1] - kept["now"][0])
    odd = [] if seconds >= STILL_SECONDS else [f"only {seconds:.1f} s, at least 5 are needed"]
    odd += refused
    odd += _check_times(kept, runtime.period)
    odd += _check_senses(kept, runtime)
    if root.has("legs"):
        odd += _check_soles(kept, Legs(root, runtime.joints.names))
    if not runtime.blind:
        odd += _check_camera(kept, manifest["depth"], runtime)
    return odd


def _check_inputs(kept: dict[str, np.ndarray], joints: int) -> Iterator[str]:
    shapes = ((3,), (3,), (3,), (joints,), (joints,), (), ())
    for name, shape in zip(INPUTS, shapes):
        given = kept[name].shape[1:]
        if kept[name].size and given != shape:
            yield f"{name} has the shape {given} in a step, in place of {shape}"
    finite = [bool(kept[name].size and np.isfinite(kept[name]).all()) for name in INPUTS]
    if not all(finite):
        yield f"not always numbers: {', '.join(np.array(INPUTS)[~np.array(finite)])}"


def _check_status(kept: dict[str, np.ndarray]) -> Iterator[str]:
    status = kept.get("status", np.zeros(0, np.int64))
    for flag, words in WHY.items():
        count = np.count_nonzero(status & int(flag & FAULTS))
        if count:
            yield f"{count} of {len(status)} steps: {words}"


def _check_times(kept: dict[str, np.ndarray], period: float) -> Iterator[str]:
    steps = np.diff(kept["now"])
    if len(steps) and abs(np.median(steps) / period - 1.0) > 0.1:
        yield f"a step every {np.median(steps):.4g} s, in place of {period:.4g}"
    elif len(steps) and np.percentile(np.abs(steps - period), 99) > MOST_JITTER * period:
        yield f"steps up to {1e3 * np.abs(steps - period).max():.0f} ms early or late"


def _check_senses(kept: dict[str, np.ndarray], runtime: Policy) -> Iterator[str]:
    gravity, gyro = kept["gravity"].mean(axis=0), kept["angular_velocity"].mean(axis=0)
    tilt = np.degrees(np.arccos(np.clip(-gravity[2] / np.linalg.norm(gravity), -1.0, 1.0)))
    if tilt > MOST_TILT:
        yield f"gravity is {tilt:.0f} deg from (0, 0, -1): {np.round(gravity, 2)}"
    if np.abs(gyro).max() > MOST_BIAS:
        yield f"the gyro says {np.round(gyro, 3)} rad/s of a robot that stands"
    for name in ("gravity", "angular_velocity"):
        if (np.ptp(kept[name], axis=0) == 0.0).all():
            yield f"{name} never changes: nothing measures it"
    offset = kept["q"].mean(axis=0) - runtime.joints.default
    for j in np.flatnonzero(np.abs(offset) > MOST_OFFSET):
        yield f"{runtime.joints.names[j]} is {offset[j]:+.2f} rad from the default pose"
    speed = kept["qd"].mean(axis=0)
    for j in np.flatnonzero(np.abs(speed) > MOST_SPEED):
        yield f"{runtime.joints.names[j]} turns by {speed[j]:+.2f} rad/s while it stands"


def _check_soles(kept: dict[str, np.ndarray], legs: Legs) -> Iterator[str]:
    down = legs.down(kept["q"].mean(axis=0).astype(np.float32))
    gravity = kept["gravity"].mean(axis=0)
    tilts = np.degrees(np.arccos(np.clip(down @ gravity / np.linalg.norm(gravity), -1.0, 1.0)))
    if tilts.max() > MOST_TILT:
        yield f"by gravity and joint angles the soles are {np.round(tilts)} deg from level"


def _check_camera(
    kept: dict[str, np.ndarray], depth: dict[str, Any], runtime: Policy
) -> Iterator[str]:
    frames, count = kept["frames"], len(kept["stamps"])
    if not count or frames.shape[1:] != runtime.image_shape:
        yield f"no frames of {runtime.image_shape}: {frames.shape[1:]}" if count else "no frames"
        return
    arrival = kept["now"][np.clip(kept["frame_step"], 0, len(kept["now"]) - 1)]
    age = np.median(arrival - kept["stamps"].astype(float))
    if not -0.02 <= age <= 0.1:
        yield f"frames are {age:.3g} s old when they come: another clock?"
    scale = float(kept["depth_scale"]) if frames.dtype == np.uint16 else 1.0
    metres = frames[-1] * scale
    known = (metres > 0.0) & (metres < depth["d_max_m"])
    if known.mean() < 0.3:
        yield f"{100 * known.mean():.0f} % of the pixels show anything nearer than d_max"
        return
    pitch, wanted = _fit_pitch(metres, known, depth), depth["mount"]["pitch_deg"]
    x, _, z = kept["gravity"][-1]
    pitch -= np.degrees(np.arctan2(x, -z))  # by as much the robot's nose is down, and the camera
    if abs(pitch - wanted) > MOST_TILT:
        yield (
            f"the camera looks down by {pitch:.0f} deg, in place of {wanted:.0f}, if the ground is "
            "level: another view, mount or order of rows?"
        )


def _fit_pitch(metres: np.ndarray, known: np.ndarray, depth: dict[str, Any]) -> float:
    """Compute how far below the horizon a camera over level ground looks, deg.

    1 / depth is (sin p + y cos p) / height, for a ray of slope y below the optical axis.
    """
    rows = len(metres)
    half = np.tan(np.radians(0.5 * depth["view_deg"]["vertical"]))
    slopes = np.broadcast_to((((2 * np.arange(rows) + 1) / rows - 1) * half)[:, None], metres.shape)
    slope, level = np.polyfit(slopes[known], 1.0 / metres[known], 1)
    return float(np.degrees(np.arctan2(level, slope)))
