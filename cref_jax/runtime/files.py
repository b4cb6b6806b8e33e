"""The files of a policy, read from a directory or a .zip, and checked against their digests."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cref_jax.runtime.tables import PolicyFormatError, Table

SCHEMA = 1  # of the manifest; to be incremented when this file would misread a newer one
MOST_BYTES = {"manifest.json": 1 << 20, "cref_runtime.py": 1 << 20}
MOST_BYTES_OF_ARRAYS = 1 << 28  # of every other file
_NPY = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '(?P<kind><f4|<f8|<i8|\|b1)', 'fortran_order': False, "
    rb"'shape': \((?P<shape>[0-9, ]{0,99})\), \}",
    re.DOTALL,
)


def contents(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the manifest and the arrays of weights.npz, by name, as exported.

    Raises:
        PolicyFormatError: a file is missing, damaged or of another format.
    """
    with one_error(path):
        manifest = read_manifest(read_file(path, "manifest.json"))
        return manifest, parse_arrays(read_verified(path, "weights.npz", manifest))


@contextlib.contextmanager
def one_error(path: str | os.PathLike[str]) -> Iterator[None]:
    """Convert any exception into a PolicyFormatError that names the path."""
    try:
        yield
    except PolicyFormatError as error:
        message = str(error) if str(error).startswith(str(path)) else f"{path}: {error}"
        raise PolicyFormatError(message) from None
    except Exception as error:  # json, zipfile and numpy raise many kinds on damaged files
        raise PolicyFormatError(f"{path}: {type(error).__name__}: {error}") from None


def read_file(path: str | os.PathLike[str], name: str) -> bytes:
    """Read a file of the directory, or of the .zip."""
    place, most = Path(path), MOST_BYTES.get(name, MOST_BYTES_OF_ARRAYS)
    if not place.exists():
        raise PolicyFormatError("no such directory or .zip")
    file, limit = (place / name, most) if place.is_dir() else (place, 2 * MOST_BYTES_OF_ARRAYS)
    if not file.is_file():
        raise PolicyFormatError(f"no file {name}")
    if file.stat().st_size > limit:
        raise PolicyFormatError(f"{file.name} is larger than {limit} bytes")
    data = file.read_bytes()
    if place.is_dir():
        return data
    files = _read_zip(data, "the .zip")
    if len(files.get(name, b"")) > most:
        raise PolicyFormatError(f"{name} is larger than {most} bytes")
    if name not in files:
        raise PolicyFormatError(f"no file {name}")
    return files[name]


def _read_zip(data: bytes, where: str) -> dict[str, bytes]:
    """Read the files of a .zip by name; only stored (uncompressed) ones, so none can expand."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()
        names = [member.filename for member in members]
        if len(set(names)) < len(names):
            raise PolicyFormatError(f"{where} has two files of one name")
        for member in members:
            if member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:
                raise PolicyFormatError(f"{where} is compressed or encrypted")
        if sum(member.file_size for member in members) > len(data):
            raise PolicyFormatError(f"{where} is smaller than the sizes in its index")
        return {member.filename: archive.read(member) for member in members}


def read_manifest(data: bytes) -> dict[str, Any]:
    """Parse the manifest strictly and check its digest."""

    def constant(name: str) -> Any:
        raise PolicyFormatError(f"manifest.json has {name} for a number")

    def unique(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(pairs)) < len(pairs):
            raise PolicyFormatError("manifest.json has a key twice")
        return dict(pairs)

    manifest = json.loads(data.decode("utf-8"), parse_constant=constant, object_pairs_hook=unique)
    table = Table(manifest, "manifest")
    if table.text("format") != "cref-policy":
        raise PolicyFormatError("manifest.json is not that of a policy")
    if table.whole("schema", 0, 1 << 30) != SCHEMA:
        raise PolicyFormatError(f"schema {manifest['schema']}, but this program reads {SCHEMA}")
    if table.text("digest") != manifest_digest(manifest):
        raise PolicyFormatError("manifest.json is not what was exported: its digest differs")
    return manifest


def manifest_digest(manifest: dict[str, Any]) -> str:
    """Compute the SHA-256 of a manifest without its own digest."""
    rest = {key: value for key, value in manifest.items() if key != "digest"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def read_verified(path: str | os.PathLike[str], name: str, manifest: dict[str, Any]) -> bytes:
    """Read a file and check its digest against the manifest."""
    data, digest = read_file(path, name), Table(manifest, "manifest").table("files").text(name)
    if hashlib.sha256(data).hexdigest() != digest:
        raise PolicyFormatError(f"{name} is not what was exported: its digest differs")
    return data


def parse_arrays(data: bytes) -> dict[str, np.ndarray]:
    """Parse the arrays of an .npz by name, without a copy; refuse pickles and objects."""
    arrays = {}
    for name, member in _read_zip(data, "an .npz").items():
        match = _NPY.match(member[:4096])
        if not match or not name.endswith(".npy"):
            raise PolicyFormatError(f"'{name[:60]}' is not an array of numbers")
        kind, text = match.group("kind").decode(), match.group("shape").decode()
        shape = tuple(int(n) for n in text.split(",") if n.strip())
        start = int.from_bytes(member[8:10], "little") + 10
        size = np.dtype(kind).itemsize
        for n in shape:
            size *= n
        if (
            start < match.end()
            or member[match.end() : start].strip()
            or len(member) - start != size
        ):
            raise PolicyFormatError(f"'{name[:60]}' does not have the size in its header")
        arrays[name[:-4]] = np.frombuffer(member, kind, offset=start).reshape(shape)
    return arrays
