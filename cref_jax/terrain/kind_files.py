"""Parameters of each kind of lane, read from the TOML files in `terrains/`."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from cref_jax import config
from cref_jax.config import folders
from cref_jax.errors import ConfigError
from cref_jax.terrain import map_files
from cref_jax.terrain.generators import KINDS, Range


def terrain_names() -> list[str]:
    """Return the names of the files in `terrains/`."""
    return sorted(path.stem for path in folders.data_folder("terrains").glob("*.toml"))


@dataclass(frozen=True)
class _Levels:
    """The sizes of one kind in Table II, m."""

    easy: float
    medium: float
    hard: float
    ood: float


class KindNumbers(NamedTuple):
    """Parameters of one kind in a terrain file."""

    train: Range  # m, size at the lowest and the highest level
    levels: _Levels | None  # m, sizes for evaluation
    shape: Any  # an instance of the kind's `shape` type in KINDS
    practice: Any  # the same for training lanes


@dataclass(frozen=True)
class _KindsFile:
    """A terrain file that defines kinds."""

    kinds: tuple[str, ...]
    train: Range
    levels: dict
    shape: dict
    practice: dict  # overrides of the shape on training lanes


@dataclass(frozen=True)
class _MixFile:
    """A terrain file that combines all kinds of other files."""

    mix: tuple[str, ...]
    shares: dict  # relative number of robots per kind of a file; 1 if not listed


def read_kinds(name: str) -> dict[str, KindNumbers]:
    """Read the parameters of each kind of a terrain, given by name or by file.

    Raises:
        ConfigError: no such terrain, or an unusable file.
    """
    table, where = _load_table(name)
    if "mix" not in table:
        return _parse_kinds(table, where)
    numbers: dict[str, KindNumbers] = {}
    source: dict[str, str] = {}  # the part that defines each kind
    for part in _parse_mix(table, where).mix:
        for kind, found in _parse_kinds(*_load_table(part)).items():
            if kind in numbers:
                raise ConfigError(
                    f"{where}: mix: '{source[kind]}' and '{part}' both define the kind '{kind}'"
                )
            numbers[kind], source[kind] = found, part
    if not numbers:
        raise ConfigError(f"{where}: mix must name at least one terrain")
    return numbers


def round_robin_kinds(name: str, kinds: tuple[str, ...]) -> tuple[int, ...]:
    """Compute the round-robin order of kinds, each repeated by its share."""
    table, where = _load_table(name)
    share = dict.fromkeys(kinds, 1)
    if "mix" in table:
        for part, count in _parse_mix(table, where).shares.items():
            share |= dict.fromkeys(_parse_kinds(*_load_table(part)), count)
    rounds = range(max(share.values()))
    return tuple(k for r in rounds for k, kind in enumerate(kinds) if r < share[kind])


def _parse_mix(table: dict[str, Any], where: str) -> _MixFile:
    """Parse the tables of a terrain file that combines other files."""
    file = read_record(_MixFile, {"shares": {}} | table, where)
    for part, count in file.shares.items():
        if part not in file.mix:
            raise ConfigError(f"{where}: shares names '{part}', which is not in mix")
        if not isinstance(count, int) or count < 1:
            raise ConfigError(f"{where}: the share of '{part}' must be 1, 2, ..., not {count}")
    return file


def _load_table(name: str) -> tuple[dict[str, Any], str]:
    """Load the tables and the file name of a terrain, given by name or by file."""
    path = Path(name)
    if path.suffix != ".toml":
        known = terrain_names()
        if name not in known:
            raise ConfigError(config.describe_unknown("terrain", name, known))
        path = folders.data_folder("terrains") / f"{name}.toml"
    table = config.load_toml(path)
    config.check_finite(table, path.name)
    return table, path.name


def read_kind(c: config.Terrain, kind: str) -> KindNumbers:
    """Read the parameters of one kind, from the terrain's own file or a default that defines it."""
    if kind not in KINDS:
        raise ConfigError(config.describe_unknown("kind", kind, list(KINDS)))
    for name in [c.name, "mixed", *terrain_names()]:
        numbers = {} if map_files.is_map(name) else read_kinds(name)
        if kind in numbers:
            return numbers[kind]
    raise ConfigError(f"neither '{c.name}' nor any file in terrains/ has the kind '{kind}'")


def _parse_kinds(table: dict[str, Any], where: str) -> dict[str, KindNumbers]:
    """Parse the tables of a terrain file that defines kinds."""
    if "mix" in table:
        raise ConfigError(f"{where} is a mix itself; a mix names terrains that define kinds")
    file = read_record(_KindsFile, {"levels": {}, "shape": {}, "practice": {}} | table, where)
    if not 0.0 <= file.train[0] <= file.train[1]:
        raise ConfigError(f"{where}: train must be [lowest, highest], not {list(file.train)}")
    if not file.kinds:
        raise ConfigError(f"{where}: kinds must name at least one of {', '.join(KINDS)}")
    levels = read_record(_Levels, file.levels, f"{where}: levels") if file.levels else None
    numbers = {}
    for kind in file.kinds:
        if kind not in KINDS:
            raise ConfigError(config.describe_unknown("kind", kind, list(KINDS)))
        shape = _parse_shape(kind, file.shape, f"{where}: shape")
        practice = _parse_shape(kind, file.shape | file.practice, f"{where}: practice")
        numbers[kind] = KindNumbers(file.train, levels, shape, practice)
    return numbers


def _parse_shape(kind: str, table: dict[str, Any], where: str) -> Any:
    """Parse the shape parameters of a kind.

    Raises:
        ConfigError: a value is not above zero, or a list is not rising.
    """
    shape = read_record(KINDS[kind].shape, table, where)
    for key, value in table.items():
        numbers = value if isinstance(value, list) else [value]
        if not numbers or numbers[0] <= 0 or numbers != sorted(numbers):
            raise ConfigError(f"{where}: {key} must be above zero and rising, not {value}")
    return shape


def read_record(cls: type, table: dict[str, Any], where: str) -> Any:
    """Parse a table as the record `cls`; every field is required."""
    names = {f.name for f in dataclasses.fields(cls)}
    missing = sorted(names - table.keys())
    if missing and table.keys() <= names:
        raise ConfigError(f"{where}: '{missing[0]}' is missing")
    return config.override(object.__new__(cls), table, where=f"{where}: ")
