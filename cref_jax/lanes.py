"""The lanes that robots walk on: their numbers from TOML, and one grid of them all.

A file in `terrains/` names kinds of lane, says how large their obstacles are at the lowest and at
the highest level, and gives what else their shapes need. A user's own height map is a lane as well.
"""

import dataclasses
import difflib
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, no_type_check

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray
from PIL import Image

from cref_jax import config, terrain
from cref_jax.errors import ConfigError
from cref_jax.shapes import KINDS, Heights, Range, columns, level_places
from cref_jax.terrain import Grid, Terrain

MAP_START = 0.75  # m, x of a user's start in the lane's coordinates; assumed: within START
MAX_COLUMNS = 2e8  # of a grid; 0.8 GB; assumed


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@flax.struct.dataclass
class Atlas:
    """All lanes in one grid: rows are the variants of each level, columns are kinds."""

    terrain: Grid
    places: Float[np.ndarray | Array, "rows kinds places 2"]  # m, x and height of level stretches
    # before the last obstacle of each lane; NaN where there are none
    sizes: Float[np.ndarray | Array, "levels kinds"]  # m; m/m for a slope
    kinds: tuple[str, ...] = flax.struct.field(pytree_node=False)
    is_profile: tuple[bool, ...] = flax.struct.field(pytree_node=False)  # each kind: level across
    turns: tuple[int, ...] = flax.struct.field(pytree_node=False)  # kinds that robots get in turn
    variants: int = flax.struct.field(pytree_node=False, default=1)  # of each level of each kind

    @property
    def levels(self) -> int:
        """Number of levels."""
        return self.sizes.shape[0]

    @property
    def length(self) -> float:
        """Length of a lane, m."""
        return self.terrain.size[0] * self.terrain.cell

    @property
    def end(self) -> Float[ArrayLike, ""]:
        """Where a lane ends, m along it."""
        return self.terrain.origin[0] + self.length

    def kind_of(self, robot: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
        """Return the kind of lane that the robots of these numbers are on."""
        return np.asarray(self.turns)[robot % len(self.turns)]

    def tile(
        self, level: Int[ArrayLike, ""], kind: Int[ArrayLike, ""], variant: Int[ArrayLike, ""] = 0
    ) -> Terrain:
        """Return one lane: x from 0 at its start, y from 0 in its middle, z = 0 at the start."""
        return terrain.tile(self.terrain, level * self.variants + variant, kind)

    def level_place(
        self,
        kind: Int[Array, ""],
        level: Int[Array, ""],
        variant: Int[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Draw where a robot may start on a lane, x and height, m; NaN where at its start alone."""
        of_lane = jnp.asarray(self.places)[level * self.variants + variant, kind]
        x, z = of_lane[jax.random.randint(key, (), 0, of_lane.shape[0])]
        return x, z


def build(c: config.Terrain) -> Atlas:
    """Return the lanes of a terrain, or a user's own height map.

    Raises:
        ConfigError: no such terrain, or a file that cannot be used.
    """
    path = Path(c.name)
    if path.suffix in (".npy", ".png"):
        return _own_map(path)
    _check_lane(c)
    numbers = _numbers(c.name)
    numbers = {kind: n._replace(shape=n.practice) for kind, n in numbers.items()}
    sizes = np.stack([np.linspace(*n.train, c.levels) for n in numbers.values()], axis=1)
    seeds = [c.seed + variant for variant in range(c.variants)] * c.levels
    atlas = _atlas(c, numbers, np.repeat(sizes, c.variants, axis=0), seeds)
    return atlas.replace(sizes=sizes, turns=_turns(c.name, atlas.kinds), variants=c.variants)


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
    numbers = {kind: _numbers_of(c, kind) for kind in sizes}
    levels = np.repeat(np.array(list(sizes.values()), float).T, len(seeds), axis=0)
    return _atlas(c, numbers, levels, list(seeds) * (len(levels) // len(seeds)))


def named_sizes(c: config.Terrain, kind: str) -> dict[str, float]:
    """Return the sizes a kind is evaluated at: easy, medium, hard, ood, m; nothing if none are."""
    levels = _numbers_of(c, kind).levels
    return dataclasses.asdict(levels) if levels else {}


def directory() -> Path:
    """Return where the terrain files are: in an installed package, or beside it in a checkout."""
    package = Path(__file__).parent
    return next(d for d in (package / "terrains", package.parent / "terrains") if d.is_dir())


@dataclass(frozen=True)
class _Levels:
    """The sizes of one kind in Table II, m."""

    easy: float
    medium: float
    hard: float
    ood: float


class _Numbers(NamedTuple):
    """What a terrain file says about a kind."""

    train: Range  # m, size at the lowest and the highest level
    levels: _Levels | None  # m, sizes for evaluation
    shape: Any  # the record that KINDS names
    practice: Any  # the same for the lanes of training


@dataclass(frozen=True)
class _KindsFile:
    """A terrain file that defines kinds."""

    kinds: tuple[str, ...]
    train: Range
    levels: dict
    shape: dict
    practice: dict  # what differs from the shape on the lanes of training


@dataclass(frozen=True)
class _MixFile:
    """A terrain file that takes all kinds of other ones."""

    mix: tuple[str, ...]
    shares: dict  # robots on each kind of a file, of those on a kind whose file is not named


@dataclass(frozen=True)
class _MapFile:
    """The file beside a user's height map."""

    cell: float  # m, side of a column
    start: tuple[float, float]  # m, from the map's first corner to where the robot starts
    scale: float  # m for one step of the map's values


def _atlas(
    c: config.Terrain, numbers: dict[str, _Numbers], sizes: np.ndarray, seeds: list[int]
) -> Atlas:
    """Return the lanes of each kind at its sizes [levels, kinds] and seeds."""
    size = columns(c.lane_length, c), columns(c.lane_width, c)
    stored, places, is_profile = [], [], []
    for k, (kind, n) in enumerate(numbers.items()):
        _check_columns((size[0] * len(seeds), size[1]), f"'{kind}' of terrain '{c.name}'")
        drawn = [_lane(c, n.shape, kind, float(sizes[row, k]), s) for row, s in enumerate(seeds)]
        level_across = all((lane == lane[:, :1]).all() for lane in drawn)
        is_profile.append(level_across)
        places.append([level_places(lane[:, size[1] // 2], c.cell) for lane in drawn])
        stored.append([lane[:, :1].copy() if level_across else lane for lane in drawn])
    origin = (0.0, -0.5 * size[1] * c.cell)
    return Atlas(
        terrain=terrain.grid(list(zip(*stored, strict=True)), c.cell, origin, size),
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


def _check_columns(shape: tuple[int, int], what: str) -> None:
    """Refuse a grid that would not fit into memory."""
    if shape[0] * shape[1] > MAX_COLUMNS:
        raise ConfigError(f"{what} has {shape[0]} x {shape[1]} columns, more than {MAX_COLUMNS:g}")


def _numbers(name: str) -> dict[str, _Numbers]:
    """Return what a terrain, named or given by its file, says about each of its kinds."""
    table, where = _table(name)
    if "mix" not in table:
        return _kinds(table, where)
    numbers: dict[str, _Numbers] = {}
    for part in _mix(table, where).mix:
        numbers |= _kinds(*_table(part))
    if not numbers:
        raise ConfigError(f"{where}: mix must name at least one terrain")
    return numbers


def _turns(name: str, kinds: tuple[str, ...]) -> tuple[int, ...]:
    """Return the kinds that robots are put on in turn, as often as the terrain's shares ask for."""
    table, where = _table(name)
    share = dict.fromkeys(kinds, 1)
    if "mix" in table:
        for part, count in _mix(table, where).shares.items():
            share |= dict.fromkeys(_kinds(*_table(part)), count)
    rounds = range(max(share.values()))
    return tuple(k for r in rounds for k, kind in enumerate(kinds) if r < share[kind])


def _mix(table: dict[str, Any], where: str) -> _MixFile:
    """Return what a terrain file says that takes all kinds of other ones."""
    file = _record(_MixFile, {"shares": {}} | table, where)
    for part, count in file.shares.items():
        if part not in file.mix:
            raise ConfigError(f"{where}: shares names '{part}', which is not in mix")
        if not isinstance(count, int) or count < 1:
            raise ConfigError(f"{where}: the share of '{part}' must be 1, 2, ..., not {count}")
    return file


def _table(name: str) -> tuple[dict[str, Any], str]:
    """Return the tables and the file name of a terrain, named or given by its file."""
    path = Path(name)
    if path.suffix != ".toml":
        known = sorted(path.stem for path in directory().glob("*.toml"))
        if name not in known:
            raise _unknown("terrain", name, known)
        path = directory() / f"{name}.toml"
    return config.load_toml(path), path.name


def _numbers_of(c: config.Terrain, kind: str) -> _Numbers:
    """Return the numbers of one kind, from the terrain's own file or from that which defines it."""
    if kind not in KINDS:
        raise _unknown("kind", kind, KINDS)
    for name in [c.name, "mixed", "flight"]:
        numbers = {} if Path(name).suffix in (".npy", ".png") else _numbers(name)
        if kind in numbers:
            return numbers[kind]
    raise ConfigError(f"neither '{c.name}' nor 'mixed' nor 'flight' has the kind '{kind}'")


def _kinds(table: dict[str, Any], where: str) -> dict[str, _Numbers]:
    """Return the numbers in the tables of a terrain file that defines kinds."""
    if "mix" in table:
        raise ConfigError(f"{where} is a mix itself; a mix names terrains that define kinds")
    file = _record(_KindsFile, {"levels": {}, "shape": {}, "practice": {}} | table, where)
    if not 0.0 <= file.train[0] <= file.train[1]:
        raise ConfigError(f"{where}: train must be [lowest, highest], not {list(file.train)}")
    if not file.kinds:
        raise ConfigError(f"{where}: kinds must name at least one of {', '.join(KINDS)}")
    levels = _record(_Levels, file.levels, f"{where}: levels") if file.levels else None
    numbers = {}
    for kind in file.kinds:
        if kind not in KINDS:
            raise _unknown("kind", kind, KINDS)
        shape = _shape(kind, file.shape, f"{where}: shape")
        practice = _shape(kind, file.shape | file.practice, f"{where}: practice")
        numbers[kind] = _Numbers(file.train, levels, shape, practice)
    return numbers


def _shape(kind: str, table: dict[str, Any], where: str) -> Any:
    """Return the record that a kind's shape is drawn from.

    Raises:
        ConfigError: numbers that no lane can be made of.
    """
    shape = _record(KINDS[kind].shape, table, where)
    for key, value in table.items():
        numbers = value if isinstance(value, list) else [value]
        if not numbers or numbers[0] <= 0 or numbers != sorted(numbers):
            raise ConfigError(f"{where}: {key} must be above zero and rising, not {value}")
    return shape


def _record(cls: type, table: dict[str, Any], where: str) -> Any:
    """Return a table as the record `cls`, every field of which it must give."""
    names = {f.name for f in dataclasses.fields(cls)}
    missing = sorted(names - table.keys())
    if missing and table.keys() <= names:
        raise ConfigError(f"{where}: '{missing[0]}' is missing")
    return config.override(object.__new__(cls), table, where=f"{where}: ")


def _unknown(what: str, name: str, known: Iterable[str]) -> ConfigError:
    """Return the error that names what is nearest to an unknown name."""
    near = difflib.get_close_matches(name, list(known), n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    return ConfigError(f"unknown {what} '{name}'; {hint}known: {', '.join(known)}")


def _own_map(path: Path) -> Atlas:
    """Return a user's height map as one lane whose start lies at x = MAP_START, y = 0, z = 0.

    An array's first axis is x. A picture is seen from above: x to the right, y up.
    """
    heights = _picture(path) if path.suffix == ".png" else _array(path)
    file_path = path.with_suffix(".toml")
    table = config.load_toml(file_path)
    file = _record(
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
    grid = terrain.grid([[heights.astype(np.float32)]], file.cell, origin, heights.shape)
    is_profile = bool((heights == heights[:, :1]).all())
    nowhere = np.full((1, 1, 1, 2), np.nan, np.float32)
    return Atlas(grid, nowhere, np.zeros((1, 1)), ("custom",), (is_profile,), (0,))


def _array(path: Path) -> np.ndarray:
    """Return the heights in a .npy file, f64[X, Y]."""
    try:
        heights = np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise ConfigError(f"no file {path}") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {error}") from None
    if heights.ndim != 2 or 0 in heights.shape or heights.dtype.kind not in "fiu":
        raise ConfigError(f"{path} must hold numbers [X, Y], not {heights.dtype}{heights.shape}")
    _check_columns(heights.shape, str(path))
    heights = heights.astype(np.float64)
    if not np.isfinite(heights).all():
        raise ConfigError(f"{path} has {np.sum(~np.isfinite(heights))} heights that are not finite")
    return heights


def _picture(path: Path) -> np.ndarray:
    """Return the values of a grey .png of 8 or 16 bits, f64[X, Y]."""
    try:
        with Image.open(path) as image:
            _check_columns(image.size, str(path))
            if image.mode not in ("L", "I", "I;16", "I;16B"):
                raise ConfigError(f"{path} must be grey with 8 or 16 bits, not {image.mode}")
            return np.asarray(image)[::-1].T.astype(np.float64)
    except FileNotFoundError:
        raise ConfigError(f"no file {path}") from None
    except (OSError, Image.DecompressionBombError) as error:
        raise ConfigError(f"{path}: {error}") from None
