"""Files that stay readable where a program was killed while it wrote, or the disk was full."""

import json
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
