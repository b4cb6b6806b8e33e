"""A trained policy as a directory that needs nothing of this package, and back.

manifest.json      everything but the weights, with units, frames and where it comes from
weights.npz        float32 by flat names, stored
testvectors.npz    what the network said in training: see vectors.py
cref_runtime.py    deploy.py, which runs the policy with numpy alone
"""

import contextlib
import dataclasses
import datetime
import hashlib
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cref_jax import config, deploy, learn, learner, leaves, ppo, robot, runs, vectors
from cref_jax.config import Config, folders
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.runs import Policy

BUNDLED = "mixed"  # the policy that comes with the package
HOLD_STEPS = 5  # assumed: 0.1 s on the last target, then the robot is let down
STALE = 0.1  # s, two frames of the camera
MOST_INVALID = 0.5  # of a frame's pixels; assumed: beyond, the last frame tells more
ZIPPED = (1980, 1, 1, 0, 0, 0)  # date of every file: equal policies are equal bytes


def write(policy: Policy, world: World, out: Path) -> None:
    """Write the directory, and beside it the same as one .zip.

    Raises:
        ConfigError: the disk refused, or another file stands there.
    """
    weights = leaves.on_host(policy.train.params.actor["params"])
    files = {
        "weights.npz": _npz({k: x.astype(np.float32) for k, x in weights.items()}),
        "testvectors.npz": _npz(vectors.test_vectors(world, policy.train)),
        "cref_runtime.py": Path(deploy.__file__).read_bytes(),
    }
    _write(out, manifest(policy, world.physics.robot), files)


def refresh(path: Path) -> None:
    """Give an exported policy the runtime of this version; all else stays as it is.

    Raises:
        ConfigError: it is no policy, or the disk refused.
    """
    content, _ = _contents(path)
    if not path.is_dir():
        raise ConfigError(f"{path} is not a directory")
    files = {name: (path / name).read_bytes() for name in content["files"]}
    files["cref_runtime.py"] = Path(deploy.__file__).read_bytes()
    _write(path, content, files)


def _write(out: Path, content: dict[str, Any], files: dict[str, bytes]) -> None:
    """Write the files and a manifest with their digests, and beside them one .zip."""
    content["files"] = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    content["digest"] = deploy.manifest_digest(content)
    files["manifest.json"] = (json.dumps(content, indent=2, allow_nan=False) + "\n").encode()
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            (out / name).write_bytes(data)
        out.with_name(out.name + ".zip").write_bytes(_stored(files))
    except OSError as error:
        raise ConfigError(f"cannot write {out}: {error.strerror}") from None


def chosen(run: Path | None, policy: Path | None) -> Path:
    """Return the run or the exported policy to look at: the newest run, or the bundled policy.

    Raises:
        ConfigError: both are given.
    """
    if run and policy:
        raise ConfigError("give --run or --policy, not both")
    with contextlib.suppress(ConfigError):
        return run or policy or runs.newest()
    return bundled()


def bundled() -> Path:
    """Return the policy that comes with the package."""
    return folders.data_folder("policies") / BUNDLED


def is_run(path: Path) -> bool:
    """Return whether this is a run and not an exported policy."""
    return path.suffix not in (".zip", ".npz") and not (path / "manifest.json").is_file()


def read_config(path: Path) -> Config:
    """Return the settings that a run, what it has learned, or an exported policy was trained with.

    Raises:
        ConfigError: it is none of these.
    """
    if learner.is_learner(path):
        return learner.read_config(path)
    return runs.read_config(path) if is_run(path) else _config(_contents(path)[0])


def load(path: Path, world: World) -> Policy:
    """Return the policy of a run, of what it has learned, or an exported one, to evaluate in JAX.

    Raises:
        ConfigError: it is none of these.
        CheckpointError: the run has no checkpoint that can be read.
    """
    if learner.is_learner(path):
        return learner.read(path, world)
    return runs.load_policy(path, world) if is_run(path) else read(path, world)


def read(path: Path, world: World | None = None) -> Policy:
    """Return an exported policy as one to evaluate in JAX; its critic is not in it, so it is zero.

    Raises:
        ConfigError: it is not a policy that this program can read.
    """
    content, arrays = _contents(path)
    c = _config(content)
    like = jax.eval_shape(lambda w: learn.initial_state(w).train, world or runs.world_of(c))
    train = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    actor = leaves.filled(
        train.params.actor, {f"params/{k}": jnp.array(x) for k, x in arrays.items()}
    )
    seen = content["observation"]
    obs = train.statistics.obs.replace(mean=jnp.array(seen["mean"]), std=jnp.array(seen["std"]))
    train = train.replace(
        params=train.params._replace(actor=actor),
        statistics=train.statistics._replace(obs=obs),
    )
    return Policy(c, train, content["provenance"]["iteration"], path)


def digest(policy: Policy) -> str:
    """Return the SHA-256 of all that decides what a policy does, the same for run and export."""
    c = policy.config
    settings = [dataclasses.asdict(part) for part in (c.network, c.robot, c.camera)]
    found = hashlib.sha256(json.dumps(settings).encode())
    arrays = leaves.on_host(policy.train.params.actor["params"])
    seen = policy.train.statistics.obs
    for name, array in sorted({**arrays, "mean": seen.mean, "std": seen.std}.items()):
        found.update(name.encode())
        found.update(np.ascontiguousarray(array, np.float32).tobytes())
    return found.hexdigest()


def begun(fresh: ppo.TrainState, policy: Policy) -> ppo.TrainState:
    """Return the state of a new training whose actor begins as this policy's."""
    seen = policy.train.statistics.obs
    statistics = fresh.statistics.obs.replace(
        mean=seen.mean,
        std=seen.std,
        summed_variance=policy.samples * jnp.square(seen.std),
        count=fresh.statistics.obs.count + policy.samples,
    )
    return fresh.replace(
        params=fresh.params._replace(actor=policy.train.params.actor),
        statistics=fresh.statistics._replace(obs=statistics),
    )


def manifest(policy: Policy, driven: robot.Robot) -> dict[str, Any]:
    """Return everything but the weights, without digests."""
    c = policy.config
    return {
        "format": "cref-policy",
        "schema": deploy.SCHEMA,
        "rates": {
            "control_hz": 1.0 / c.physics.control_period,
            "depth_hz": c.camera.rate,
            "frame_age_s": c.physics.control_period,
        },
        "joints": _joints(driven),
        "held_joints": _held(c, driven),
        "action": _action(c),
        "observation": _observation(policy.train, driven),
        "command": _command(c),
        "depth": None if c.network.variant == "blind" else _depth(c),
        "network": _network(c.network),
        "state": _state(c.network),
        "guards": _guards(driven),
        "provenance": _provenance(policy),
        "evaluation": _evaluation(policy.run),
    }


def _contents(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return an exported policy's manifest and weights, every number checked."""
    try:
        content, arrays = deploy.contents(path)
        deploy.Policy(content, arrays)
    except deploy.PolicyFormatError as error:
        raise ConfigError(str(error)) from None
    return content, arrays


def _config(content: dict[str, Any]) -> Config:
    return config.override(Config(), content["provenance"]["config"])


def _joints(driven: robot.Robot) -> list[dict[str, Any]]:
    """Return the joints that the policy drives, in the order of every array."""
    columns = {
        "default_rad": driven.nominal_pose,
        "action_scale_rad": driven.action_scale,
        "low_rad": driven.range_low,
        "high_rad": driven.range_high,
        "velocity_rad_s": driven.velocity_limit,
        "kp": driven.kp,
        "kd": driven.kd,
        "effort_nm": driven.effort,
    }
    return [
        {"name": name, **{key: float(values[j]) for key, values in columns.items()}}
        for j, name in enumerate(driven.joint_names)
    ]


def _held(c: Config, driven: robot.Robot) -> list[dict[str, Any]]:
    """Return the joints that the robot itself has to hold at their default."""
    whole = robot.load(dataclasses.replace(c.robot, actuated="all"))
    keys = ("name", "default_rad", "kp", "kd", "effort_nm")
    return [
        {key: joint[key] for key in keys}
        for joint in _joints(whole)
        if joint["name"] not in driven.joint_names
    ]


def _action(c: Config) -> dict[str, Any]:
    return {
        "clip": c.robot.action_clip,
        "formula": "target = default_rad + action_scale_rad * clip(action, -clip, clip)",
        "torque": "clip(kp (target - q) - kd qd, -effort_nm, effort_nm)",
    }


def _observation(train: ppo.TrainState, driven: robot.Robot) -> dict[str, Any]:
    joints, statistics = len(driven.joint_names), train.statistics.obs
    base = "base: x forward, y left, z up"
    terms = [
        ("angular_velocity", 3, "rad/s", base),
        ("gravity", 3, "unit vector; (0, 0, -1) upright", base),
        ("command", 3, "m/s forward, m/s to the left, rad/s to the left", base),
        ("joint_position", joints, "rad from default_rad", "joints"),
        ("joint_velocity", joints, "rad/s", "joints"),
        ("action", joints, "the clipped action of the step before; 0 at first", "joints"),
    ]
    return {
        "terms": [dict(zip(("name", "size", "unit", "frame"), t, strict=True)) for t in terms],
        "formula": "clip((x - mean) / std, -clip, clip)",
        "mean": [float(x) for x in np.asarray(statistics.mean, np.float32)],
        "std": [float(x) for x in np.asarray(statistics.std, np.float32)],
        "clip": ppo.OBSERVATION_CLIP,
    }


def _command(c: Config) -> dict[str, Any]:
    """Return the commands that were trained, in the open and along lanes."""
    turn = max(c.command.lane_yaw_rate, *map(abs, c.command.yaw_rate))
    forward = (*c.command.vx, *c.command.lane_vx)
    return {
        "low": [min(forward), c.command.vy[0], -turn],
        "high": [max(forward), c.command.vy[1], turn],
    }


def _depth(c: Config) -> dict[str, Any]:
    whole = dataclasses.replace(c.robot, actuated="all")
    mount = robot.load(whole).camera
    model = robot.spec("all", c.physics, contact_planes=0).compile()
    rows, columns = c.camera.shape
    return {
        "rows": rows,
        "columns": columns,
        "view_deg": {"vertical": c.camera.view[0], "horizontal": c.camera.view[1]},
        "orientation": "row 0 is the top, column 0 the left; depth along the optical axis, m",
        "mount": {
            "link": model.body(mount.body).name,
            "position_m": [float(x) for x in mount.position],
            "rotation_wxyz": [float(x) for x in mount.rotation],
            "pitch_deg": c.camera.pitch,
        },
        "d_max_m": c.camera.d_max,
        "invalid": "0 and NaN are filled in from around; infinity and beyond d_max read as d_max",
        "window": c.camera.window,
        "resize": "the pixel nearest to each cell's middle, of an image with this view; a RealSense"
        " D435i has it at 848 x 480, not at 640 x 480, which shows 75 x 62 degrees",
        "formula": "float16(nearest / d_max - 0.5), nearest: of window x window pixels around",
    }


def _network(c: config.Network) -> dict[str, Any]:
    keys = ("channels", "kernel", "stride")
    return {
        "variant": c.variant,
        "convolutions": [dict(zip(keys, layer, strict=True)) for layer in c.convolutions],
        "token": c.token,
        "heads": c.heads,
        "compressed": c.compressed,
        "lstm": c.lstm,
        "gru": c.gru,
        "actor": list(c.actor),
        "activation": "elu",
        "norm_epsilon": 1e-6,
    }


def _state(c: config.Network) -> dict[str, Any]:
    return {
        "lstm_c": [c.lstm],
        "lstm_h": [c.lstm],
        "gru": [c.gru],
        "reset": "all zero, and no frame",
    }


def _guards(driven: robot.Robot) -> dict[str, Any]:
    """Return the limits of the runtime; those on targets only take what the motors cannot do.

    A target that is further from the pose than this asks for no more torque, at whatever speed.
    """
    reach = [float(x) for x in (driven.effort + driven.kd * driven.velocity_limit) / driven.kp]
    return {
        "hold_steps": HOLD_STEPS,
        "stale_s": STALE,
        "max_invalid": MOST_INVALID,
        "rate_rad": [2.0 * x for x in reach],
        "beyond_rad": reach,
    }


def _provenance(policy: Policy) -> dict[str, Any]:
    """Return where the policy comes from; the last start of its run stands for all of them."""
    c, origin = policy.config, policy.run / "origin.jsonl"
    lines = origin.read_text().splitlines() if origin.is_file() else []
    start = json.loads(lines[-1]) if lines else {"command": []}
    bare = lambda word: Path(word).name if Path(word).is_absolute() else word  # no one's folders
    start["command"] = [bare(word) for word in start["command"]]
    return {
        "exported": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "run": policy.run.name,
        "iteration": policy.iteration,
        "samples": policy.samples,
        "trained_by": start,
        "config": json.loads(json.dumps(dataclasses.asdict(c))),
    }


def _evaluation(run: Path) -> dict[str, Any] | None:
    """Return what `make eval` has last said of the run."""
    path = run / "eval.json"
    return json.loads(path.read_text()) if path.is_file() else None


def _npz(arrays: dict[str, np.ndarray]) -> bytes:
    """Return the arrays as an .npz without compression."""
    files = {}
    for name, array in sorted(arrays.items()):
        data = io.BytesIO()
        np.lib.format.write_array(data, np.ascontiguousarray(array), version=(1, 0))
        files[f"{name}.npy"] = data.getvalue()
    return _stored(files)


def _stored(files: dict[str, bytes]) -> bytes:
    """Return an archive of the files, without compression."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, ZIPPED), content)
    return data.getvalue()
