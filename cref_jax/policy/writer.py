"""A trained policy as a self-contained directory, independent of this package.

manifest.json      everything but the weights, with units, frames and origin
weights.npz        float32 by flat names, uncompressed
testvectors.npz    reference inputs and outputs of the trained network
cref_runtime.py    deploy.py and runtime/ as one file, which runs the policy with numpy alone
cref_policy.c, .h  the policy in C99 with its weights, for a robot's own controller; not for hpl
"""

import hashlib
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from cref_jax import deploy
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.policy import c_files, reader, reference_vectors, runtime_file
from cref_jax.policy.manifest import build_manifest
from cref_jax.policy.trained import TrainedPolicy
from cref_jax.system import disk
from cref_jax.training import pytree_digest

ZIPPED = (1980, 1, 1, 0, 0, 0)  # date of every file: equal policies give equal bytes


def write(policy: TrainedPolicy, world: World, out: Path) -> None:
    """Write the directory, and a .zip of the same files beside it.

    Raises:
        ConfigError: a file cannot be written, another file is in its place, or it sees what no
            robot does.
    """
    variant = policy.config.network.variant
    if variant not in deploy.VARIANTS:
        raise ConfigError(f"{variant} sees the ground's heights, which no robot measures")
    arrays = pytree_digest.on_host(policy.train.params.actor["params"])
    weights = {name: x.astype(np.float32) for name, x in arrays.items()}
    files = {
        "weights.npz": _to_npz(weights),
        "testvectors.npz": _to_npz(reference_vectors.build_test_vectors(world, policy.train)),
    }
    _write_files(out, build_manifest(policy, world.physics.robot), weights, files)


def copy(policy: Path, out: Path) -> None:
    """Write an exported policy again with the runtimes of this version; all else stays as it is.

    Raises:
        ConfigError: it is not a policy directory, or a file cannot be written.
    """
    content, weights = reader.read_contents(policy)
    if not policy.is_dir():
        raise ConfigError(f"{policy} is not a directory")
    files = {name: (policy / name).read_bytes() for name in ("weights.npz", "testvectors.npz")}
    _write_files(out, content, weights, files)


def _write_files(
    out: Path, content: dict[str, Any], weights: dict[str, np.ndarray], files: dict[str, bytes]
) -> None:
    """Write the files and the runtimes, a manifest with their digests, and one .zip beside them."""
    files["cref_runtime.py"] = runtime_file.join_files()
    if content["network"]["variant"] in c_files.VARIANTS:
        files |= c_files.write_c(content, weights)
    content["files"] = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    content["digest"] = deploy.manifest_digest(content)
    manifest = (json.dumps(content, indent=2, allow_nan=False) + "\n").encode()
    archive = out.with_name(out.name + ".zip"), _zip_stored({**files, "manifest.json": manifest})
    try:
        out.mkdir(parents=True, exist_ok=True)
        whole = dict([*((out / name, data) for name, data in files.items()), archive])
        disk.write_all({**whole, out / "manifest.json": manifest})
        for name in c_files.NAMES:  # of another policy
            if name not in files:
                (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot write {error.filename or out}: {error.strerror}") from None


def _to_npz(arrays: dict[str, np.ndarray]) -> bytes:
    """Encode the arrays as an uncompressed .npz."""
    files = {}
    for name, array in sorted(arrays.items()):
        data = io.BytesIO()
        np.lib.format.write_array(data, np.ascontiguousarray(array), version=(1, 0))
        files[f"{name}.npy"] = data.getvalue()
    return _zip_stored(files)


def _zip_stored(files: dict[str, bytes]) -> bytes:
    """Build an uncompressed archive of the files."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, ZIPPED), content)
    return data.getvalue()
