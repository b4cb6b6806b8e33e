"""The lanes that robots walk on, as one grid of all kinds and levels.

Numbers come from `kind_files`, shapes from `generators`; a user's own height map is a lane as well.
"""

import dataclasses
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cref_jax import config
from cref_jax.errors import ConfigError
from cref_jax.terrain import atlas, column_grid, heightmap, kind_files
from cref_jax.terrain.atlas import Atlas
from cref_jax.terrain.generators import KINDS, Heights, columns, level_places
from cref_jax.terrain.kind_files import KindNumbers


def build(c: config.Terrain) -> Atlas:
    """Return the lanes of a terrain, or a user's own height map.

    Raises:
        ConfigError: no such terrain, or a file that cannot be used.
    """
    path = Path(c.name)
    if path.suffix in (".npy", ".png"):
        return heightmap.read_map(path)
    _check_lane(c)
    numbers = kind_files.read_kinds(c.name)
    numbers = {kind: n._replace(shape=n.practice) for kind, n in numbers.items()}
    sizes = np.stack([np.linspace(*n.train, c.levels) for n in numbers.values()], axis=1)
    seeds = [c.seed + variant for variant in range(c.variants)] * c.levels
    atlas = _atlas(c, numbers, np.repeat(sizes, c.variants, axis=0), seeds)
    return atlas.replace(
        sizes=sizes, turns=kind_files.round_robin_kinds(c.name, atlas.kinds), variants=c.variants
    )


def single(c: config.Terrain, kind: str, size: float) -> Atlas:
    """Return one lane of one kind whose obstacles have exactly this size, m."""
    return grid(c, {kind: (size,)}, [c.seed])


def grid(c: config.Terrain, sizes: Mapping[str, Sequence[float]], seeds: Sequence[int]) -> Atlas:
    """Return lanes with obstacles of exactly these sizes of each kind, m, drawn with each seed.

    Level `i * len(seeds) + j` of a kind has its size i and seed j; all kinds have as many sizes.
    """
    _check_lane(c)
    for kind, of_kind in sizes.items():
        if not min(of_kind) >= 0.0:
            raise ConfigError(f"the size of '{kind}' must not be below zero: {min(of_kind)}")
    numbers = {kind: kind_files.read_kind(c, kind) for kind in sizes}
    levels = np.repeat(np.array(list(sizes.values()), float).T, len(seeds), axis=0)
    return _atlas(c, numbers, levels, list(seeds) * (len(levels) // len(seeds)))


def named_sizes(c: config.Terrain, kind: str) -> dict[str, float]:
    """Return the sizes a kind is evaluated at: easy, medium, hard, ood, m; nothing if none are."""
    levels = kind_files.read_kind(c, kind).levels
    return dataclasses.asdict(levels) if levels else {}


def _atlas(
    c: config.Terrain, numbers: dict[str, KindNumbers], sizes: np.ndarray, seeds: list[int]
) -> Atlas:
    """Return the lanes of each kind at its sizes [levels, kinds] and seeds."""
    size = columns(c.lane_length, c), columns(c.lane_width, c)
    stored, places, is_profile = [], [], []
    for k, (kind, n) in enumerate(numbers.items()):
        atlas.check_columns((size[0] * len(seeds), size[1]), f"'{kind}' of terrain '{c.name}'")
        drawn = [_lane(c, n.shape, kind, float(sizes[row, k]), s) for row, s in enumerate(seeds)]
        level_across = all((lane == lane[:, :1]).all() for lane in drawn)
        is_profile.append(level_across)
        places.append([level_places(lane[:, size[1] // 2], c.cell) for lane in drawn])
        stored.append([lane[:, :1].copy() if level_across else lane for lane in drawn])
    origin = (0.0, -0.5 * size[1] * c.cell)
    return Atlas(
        terrain=column_grid.grid(list(zip(*stored, strict=True)), c.cell, origin, size),
        places=np.array(places, np.float32).swapaxes(0, 1),
        sizes=sizes,
        kinds=tuple(numbers),
        is_profile=tuple(is_profile),
        turns=tuple(range(len(numbers))),
    )


def _lane(c: config.Terrain, shape: Any, kind: str, size: float, seed: int) -> Heights:
    """Return one lane, of seed, kind and size alone: it is the same in whatever mix it stands."""
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode()), round(1e4 * size)])
    return KINDS[kind].heights(c, size, shape, rng)


def _check_lane(c: config.Terrain) -> None:
    """Refuse lanes of no extent."""
    if not c.cell > 0.0 or min(c.lane_length, c.lane_width, c.levels, c.variants) <= 0:
        raise ConfigError(
            "a terrain's cell, lane_length, lane_width, levels and variants must be above zero"
        )
