"""Where the package's data files are: in an installed package, or beside it in a checkout."""

from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def data_folder(name: str) -> Path:
    """Find `constraints`, `experiments`, `policies` or `terrains`.

    They are inside an installed package, or beside it.
    """
    inside = PACKAGE / name
    return inside if inside.is_dir() else PACKAGE.parent / name
