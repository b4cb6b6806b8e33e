"""Files that stay readable where a program was killed while it wrote, or the disk was full."""

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any


def append_lines(path: Path) -> IO[str]:
    """Open a file to append lines to it, after the end of a last line that was cut."""
    with path.open("ab+") as file:
        if file.tell():
            file.seek(-1, 2)
            if file.read(1) != b"\n":
                file.write(b"\n")
    return path.open("a", encoding="utf-8")


def read_objects(path: Path) -> list[dict[str, Any]]:
    """Read the lines that are JSON objects, without any that was cut; none if there is no file."""
    objects = []
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []
    for line in lines:
        try:
            objects.append(json.loads(line))
        except (ValueError, RecursionError):
            continue
    return [found for found in objects if isinstance(found, dict)]


def write_all(files: Mapping[Path, bytes]) -> None:
    """Write files that stay as they were until each is whole; the last one is replaced last.

    Raises:
        OSError: one cannot be written; it is the error's `filename`.
    """
    parts = {path: path.with_name(f"{path.name}.part") for path in files}
    path = Path()
    try:
        for path, data in files.items():
            parts[path].write_bytes(data)
        for path, part in parts.items():
            part.replace(path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        for part in parts.values():
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
