"""The robots' lanes, built as one grid of all kinds and levels.

Parameters come from `kind_files`, shapes from `generators`; a user's height map is a lane as well.
"""

import dataclasses
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cref_jax import config
from cref_jax.config import limits
from cref_jax.errors import ConfigError
from cref_jax.terrain import atlas, column_grid, heightmap, kind_files, map_files
from cref_jax.terrain.atlas import Atlas
from cref_jax.terrain.generators import KINDS, Heights, columns, find_level_places
from cref_jax.terrain.kind_files import KindNumbers
from cref_jax.terrain.slits import cut_slits


def build(c: config.Terrain) -> Atlas:
    """Build the training lanes of a terrain, or the lane of a user's height map.

    Raises:
        ConfigError: no such terrain, or an unusable file.
    """
    path = Path(c.name)
    if map_files.is_map(c.name):
        return heightmap.read_map(path)
    _check_lane(c)
    numbers = kind_files.read_kinds(c.name)
    numbers = {kind: n._replace(shape=n.practice) for kind, n in numbers.items()}
    sizes = np.stack([np.linspace(*n.train, c.levels) for n in numbers.values()], axis=1)
    seeds = [c.seed + variant for variant in range(c.variants)] * c.levels
    slits = _assign_slits(c, numbers)
    atlas = _build_atlas(c, numbers, np.repeat(sizes, c.variants, axis=0), seeds, slits)
    return atlas.replace(
        sizes=sizes, turns=kind_files.round_robin_kinds(c.name, atlas.kinds), variants=c.variants
    )


def count_turns(c: config.Terrain) -> int:
    """Count the robots among which each kind of lane has its share."""
    if map_files.is_map(c.name):
        return 1
    return len(kind_files.round_robin_kinds(c.name, tuple(kind_files.read_kinds(c.name))))


def build_single(c: config.Terrain, kind: str, size: float) -> Atlas:
    """Build one lane of one kind with obstacles of exactly this size, m."""
    return build_grid(c, {kind: (size,)}, [c.seed])


def build_grid(
    c: config.Terrain, sizes: Mapping[str, Sequence[float]], seeds: Sequence[int]
) -> Atlas:
    """Build lanes with obstacles of exactly these sizes per kind, m, once per seed.

    Level `i * len(seeds) + j` of a kind has size i and seed j; all kinds have equally many sizes.

    Raises:
        ConfigError: an unknown kind, a size below zero, or an unusable file.
    """
    _check_lane(c)
    for kind, of_kind in sizes.items():
        if not min(of_kind) >= 0.0:
            raise ConfigError(f"the size of '{kind}' must not be below zero: {min(of_kind)}")
    numbers = {kind: kind_files.read_kind(c, kind) for kind in sizes}
    levels = np.repeat(np.array(list(sizes.values()), float).T, len(seeds), axis=0)
    return _build_atlas(c, numbers, levels, list(seeds) * (len(levels) // len(seeds)))


def named_sizes(c: config.Terrain, kind: str) -> dict[str, float]:
    """Read the evaluation sizes of a kind: easy, medium, hard, ood, m; empty if it has none."""
    levels = kind_files.read_kind(c, kind).levels
    return dataclasses.asdict(levels) if levels else {}


def _assign_slits(c: config.Terrain, kinds: Iterable[str]) -> dict[str, float]:
    """Assign each kind of lane its widest slits, m."""
    for kind in c.slit_kinds:
        if kind not in KINDS:
            unknown = config.describe_unknown("kind", kind, list(KINDS))
            raise ConfigError(f"--terrain.slit-kinds: {unknown}")
    return {kind: c.slits for kind in c.slit_kinds or kinds}


def _build_atlas(
    c: config.Terrain,
    numbers: dict[str, KindNumbers],
    sizes: np.ndarray,
    seeds: list[int],
    slits: Mapping[str, float] | None = None,
) -> Atlas:
    """Build the lanes of each kind at its sizes [levels, kinds] and seeds; its `slits` in m."""
    size = columns(c.lane_length, c), columns(c.lane_width, c)
    stored, places, is_profile = [], [], []
    for k, (kind, n) in enumerate(numbers.items()):
        atlas.check_columns((size[0] * len(seeds), size[1]), f"'{kind}' of terrain '{c.name}'")
        drawn = [
            _generate_lane(c, n.shape, kind, float(sizes[row, k]), s, (slits or {}).get(kind, 0.0))
            for row, s in enumerate(seeds)
        ]
        level_across = all((lane == lane[:, :1]).all() for lane in drawn)
        is_profile.append(level_across)
        places.append([find_level_places(lane[:, size[1] // 2], c.cell) for lane in drawn])
        stored.append([lane[:, :1].copy() if level_across else lane for lane in drawn])
    origin = (0.0, -0.5 * size[1] * c.cell)
    return Atlas(
        terrain=column_grid.build_grid(list(zip(*stored, strict=True)), c.cell, origin, size),
        places=np.array(places, np.float32).swapaxes(0, 1),
        sizes=sizes,
        kinds=tuple(numbers),
        is_profile=tuple(is_profile),
        turns=tuple(range(len(numbers))),
    )


def _generate_lane(
    c: config.Terrain, shape: Any, kind: str, size: float, seed: int, slits: float
) -> Heights:
    """Generate one lane from seed, kind and size alone: it is the same in every mix."""
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode()), round(1e4 * size)])
    heights = KINDS[kind].heights(c, size, shape, rng)
    return cut_slits(heights, slits, c.cell, rng) if slits > 0.0 else heights


def _check_lane(c: config.Terrain) -> None:
    """Check that lanes have a positive extent."""
    if not c.cell > 0.0 or min(c.lane_length, c.lane_width, c.levels, c.variants) <= 0:
        raise ConfigError(
            "a terrain's cell, lane_length, lane_width, levels and variants must be above zero"
        )
    if c.cell < limits.LEAST_CELL:
        raise ConfigError(f"'terrain.cell' must be at least {limits.LEAST_CELL} m, not {c.cell}")
