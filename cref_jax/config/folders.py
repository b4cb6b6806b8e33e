"""Where the package's files and its commands are: in an installed package, or in a checkout."""

import shlex
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def data_folder(name: str) -> Path:
    """Find `constraints`, `experiments`, `policies` or `terrains`.

    They are inside an installed package, or beside it.
    """
    inside = PACKAGE / name
    return inside if inside.is_dir() else PACKAGE.parent / name


def command_line(name: str, *words: str | Path) -> str:
    """Write a command for the shell: with `make` in a checkout, with `cref` elsewhere."""
    line = shlex.join(map(str, words))
    if not (PACKAGE.parent / "Makefile").is_file():
        return f"cref {name} {line}"
    line = line.replace("$", "$$")  # for make, which hands it to another shell
    quoted = shlex.quote(line) if set(line) & set('"$`\\!') else f'"{line}"'
    return f"make {name} ARGS={quoted}"
