"""The complete learner in one file, without the robots, to continue training elsewhere.

A checkpoint with thousands of robots takes hundreds of megabytes; the learner takes ten.
"""

import dataclasses
import io
import json
from pathlib import Path

import jax
import numpy as np

from cref_jax.config import Config, presets
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.policy.trained import TrainedPolicy, count_samples, learner_shapes
from cref_jax.system import disk
from cref_jax.training import pytree_digest

_SETTINGS, _ITERATION, _SAMPLES = "settings", "iterations", "samples"  # not the name of any leaf


def is_learner(path: Path) -> bool:
    """Check whether the file name is that of a learner file."""
    return path.suffix == ".npz"


def write(policy: TrainedPolicy, out: Path) -> None:
    """Write actor, critic, optimiser, statistics and the settings of the run.

    Raises:
        ConfigError: the file cannot be written.
    """
    arrays = pytree_digest.on_host(policy.train)
    arrays[_SETTINGS] = np.array(json.dumps(dataclasses.asdict(policy.config)))
    arrays[_ITERATION] = np.array(policy.iteration)
    arrays[_SAMPLES] = np.array(policy.samples)
    data = io.BytesIO()
    np.savez_compressed(data, **arrays)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        disk.write_all({out: data.getvalue()})
    except OSError as error:
        raise ConfigError(f"cannot write {out}: {error.strerror}") from None


def read_config(path: Path) -> Config:
    """Read the settings of the run that wrote the file.

    Raises:
        ConfigError: it is not a learner file, or from another version of the program.
    """
    text = str(_load_arrays(path)[_SETTINGS])
    try:
        settings = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: {error}") from None
    return presets.apply_table(Config(), settings, path)


def read_length(path: Path) -> tuple[int, int]:
    """Read for how many iterations and samples it was trained.

    Raises:
        ConfigError: it is not a learner file.
    """
    return _length(_load_arrays(path), read_config(path))


def _length(arrays: dict[str, np.ndarray], c: Config) -> tuple[int, int]:
    iteration = int(arrays[_ITERATION])
    return iteration, int(arrays.get(_SAMPLES, count_samples(c, iteration)))


def read(path: Path, world: World) -> TrainedPolicy:
    """Read the learner; `world` may have another terrain.

    Raises:
        ConfigError: it is not a learner file, or its network differs.
    """
    arrays, c = _load_arrays(path), read_config(path)
    like = learner_shapes(c, world)
    leaves = pytree_digest.by_path(like)
    for name, leaf in leaves.items():
        if name not in arrays or arrays[name].shape != leaf.shape:
            raise ConfigError(f"{path} does not fit these settings: {name} is not {leaf.shape}")
    placed = {name: jax.numpy.asarray(arrays[name]) for name in leaves}
    iteration, samples = _length(arrays, c)
    return TrainedPolicy(c, pytree_digest.fill_from(like, placed), iteration, path, samples)


def _load_arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path) as file:
            arrays = dict(file)
    except Exception as error:  # numpy raises many kinds for a damaged file
        raise ConfigError(f"cannot read {path}: {error}") from None
    if missing := {_SETTINGS, _ITERATION} - arrays.keys():
        raise ConfigError(f"{path} was not written by export --learner: no {sorted(missing)[0]}")
    return arrays
