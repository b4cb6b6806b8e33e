"""A user-supplied height map, .npy or .png, as a lane."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from cref_jax import config
from cref_jax.errors import ConfigError
from cref_jax.terrain import atlas, column_grid, kind_files
from cref_jax.terrain.atlas import Atlas

MAP_START = 0.75  # m, x of the map's start in the lane's coordinates; assumed: within START


@dataclass(frozen=True)
class _MapFile:
    """The TOML file beside a height map."""

    cell: float  # m, side of a column
    start: tuple[float, float]  # m, from the map's first corner to the robot's start
    scale: float  # m per unit of the map's values


def read_map(path: Path) -> Atlas:
    """Read a height map as one lane with its start at x = MAP_START, y = 0, z = 0.

    An array's first axis is x. A picture is a view from above: x to the right, y up.

    Raises:
        ConfigError: the map or the TOML file beside it is missing or unusable.
    """
    heights = _read_picture(path) if path.suffix == ".png" else _read_array(path)
    file_path = path.with_suffix(".toml")
    table = config.load_toml(file_path)
    file = kind_files.read_record(
        _MapFile, ({} if path.suffix == ".png" else {"scale": 1.0}) | table, file_path.name
    )
    if not file.cell > 0.0:
        raise ConfigError(f"{file_path.name}: cell must be above zero, not {file.cell}")
    start = tuple(int(np.floor(metres / file.cell)) for metres in file.start)
    if not all(0 <= s < n for s, n in zip(start, heights.shape, strict=True)):
        size = " x ".join(f"{n * file.cell:g}" for n in heights.shape)
        raise ConfigError(f"{file_path.name}: start {list(file.start)} is not on the map, {size} m")
    heights = (heights - heights[start]) * file.scale
    origin = (MAP_START - file.start[0], -file.start[1])
    grid = column_grid.build_grid([[heights.astype(np.float32)]], file.cell, origin, heights.shape)
    is_profile = bool((heights == heights[:, :1]).all())
    nowhere = np.full((1, 1, 1, 2), np.nan, np.float32)
    return Atlas(grid, nowhere, np.zeros((1, 1)), ("custom",), (is_profile,), (0,))


def _read_array(path: Path) -> np.ndarray:
    """Read the heights in a .npy file, f64[X, Y]."""
    try:
        heights = np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise ConfigError(f"no file {path}") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {error}") from None
    if heights.ndim != 2 or 0 in heights.shape or heights.dtype.kind not in "fiu":
        raise ConfigError(f"{path} must hold numbers [X, Y], not {heights.dtype}{heights.shape}")
    atlas.check_columns(heights.shape, str(path))
    heights = heights.astype(np.float64)
    if not np.isfinite(heights).all():
        raise ConfigError(f"{path} has {np.sum(~np.isfinite(heights))} heights that are not finite")
    return heights


def _read_picture(path: Path) -> np.ndarray:
    """Read the values of a grey .png of 8 or 16 bits, f64[X, Y]."""
    try:
        with Image.open(path) as image:
            atlas.check_columns(image.size, str(path))
            if image.mode not in ("L", "I", "I;16", "I;16B"):
                raise ConfigError(f"{path} must be grey with 8 or 16 bits, not {image.mode}")
            return np.asarray(image)[::-1].T.astype(np.float64)
    except FileNotFoundError:
        raise ConfigError(f"no file {path}") from None
    except (OSError, Image.DecompressionBombError) as error:
        raise ConfigError(f"{path}: {error}") from None
