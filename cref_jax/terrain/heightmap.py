"""A user's height map as a lane."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cref_jax import config
from cref_jax.config import limits
from cref_jax.errors import ConfigError
from cref_jax.terrain import column_grid, kind_files, map_files
from cref_jax.terrain.atlas import Atlas

MAP_START = 0.75  # m, x of the map's start in the lane's coordinates; assumed: within START
RELIEF = 100.0  # m from the start's height; assumed: more is no ground, but data of another kind


@dataclass(frozen=True)
class _MapFile:
    """The TOML file beside a height map."""

    cell: float  # m, side of a column
    start: tuple[float, float]  # m, from the map's first corner to the robot's start
    scale: float  # m per unit of the map's values


def read_map(path: Path) -> Atlas:
    """Read a height map as one lane with its start at x = MAP_START, y = 0, z = 0.

    Raises:
        ConfigError: the map or the TOML file beside it is missing or unusable.
    """
    heights = map_files.read_values(path)
    file = _read_settings(path)
    where = path.with_suffix(".toml").name
    start = tuple(int(np.floor(metres / file.cell)) for metres in file.start)
    if not all(0 <= s < n for s, n in zip(start, heights.shape, strict=True)):
        size = " x ".join(f"{n * file.cell:g}" for n in heights.shape)
        raise ConfigError(f"{where}: start {list(file.start)} is not on the map, {size} m")
    heights = (heights - heights[start]) * file.scale
    if np.abs(heights).max() > RELIEF:
        low, high = heights.min(), heights.max()
        raise ConfigError(
            f"{path}: heights of {low:.4g} to {high:.4g} m about the start's are no ground to walk "
            f"on: see values without data, and scale in {where}"
        )
    origin = (MAP_START - file.start[0], -file.start[1])
    grid = column_grid.build_grid([[heights.astype(np.float32)]], file.cell, origin, heights.shape)
    is_profile = bool((heights == heights[:, :1]).all())
    nowhere = np.full((1, 1, 1, 2), np.nan, np.float32)
    return Atlas(grid, nowhere, np.zeros((1, 1)), ("custom",), (is_profile,), (0,))


def _read_settings(path: Path) -> _MapFile:
    """Read the TOML file beside a map.

    Raises:
        ConfigError: it is missing, or a number in it cannot be used.
    """
    file_path = path.with_suffix(".toml")
    table = config.load_toml(file_path)
    is_metres = path.suffix.lower() == ".npy"
    file = kind_files.read_record(
        _MapFile, ({"scale": 1.0} if is_metres else {}) | table, file_path.name
    )
    if not np.isfinite([file.cell, *file.start, file.scale]).all():
        raise ConfigError(f"{file_path.name}: cell, start and scale must be finite")
    if not file.cell >= limits.LEAST_CELL:
        raise ConfigError(
            f"{file_path.name}: cell must be at least {limits.LEAST_CELL} m, not {file.cell}: "
            "contact looks three cells far for a wall; thin the map out"
        )
    if file.scale == 0.0:
        raise ConfigError(f"{file_path.name}: scale must not be zero")
    return file
