"""Where the package's data files are: in an installed package, or beside it in a checkout."""

from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def data_folder(name: str) -> Path:
    """Find `experiments`, `policies`, `terrains` or a file of tested versions.

    They are inside an installed package, or beside it.
    """
    inside = PACKAGE / name
    return inside if inside.exists() else PACKAGE.parent / name
