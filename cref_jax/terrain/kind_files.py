"""The numbers of each kind of lane, read from the TOML files in `terrains/`."""

import dataclasses
import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from cref_jax import config
from cref_jax.config import folders
from cref_jax.errors import ConfigError
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


def read_kinds(name: str) -> dict[str, KindNumbers]:
    """Return what a terrain, named or given by its file, says about each of its kinds."""
    table, where = _table(name)
    if "mix" not in table:
        return _kinds(table, where)
    numbers: dict[str, KindNumbers] = {}
    for part in _mix(table, where).mix:
        numbers |= _kinds(*_table(part))
    if not numbers:
        raise ConfigError(f"{where}: mix must name at least one terrain")
    return numbers


def round_robin_kinds(name: str, kinds: tuple[str, ...]) -> tuple[int, ...]:
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
    file = read_record(_MixFile, {"shares": {}} | table, where)
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
        known = terrain_names()
        if name not in known:
            raise _unknown("terrain", name, known)
        path = folders.data_folder("terrains") / f"{name}.toml"
    return config.load_toml(path), path.name


def read_kind(c: config.Terrain, kind: str) -> KindNumbers:
    """Return the numbers of one kind, from the terrain's own file or from that which defines it."""
    if kind not in KINDS:
        raise _unknown("kind", kind, KINDS)
    for name in [c.name, "mixed", "flight"]:
        numbers = {} if Path(name).suffix in (".npy", ".png") else read_kinds(name)
        if kind in numbers:
            return numbers[kind]
    raise ConfigError(f"neither '{c.name}' nor 'mixed' nor 'flight' has the kind '{kind}'")


def _kinds(table: dict[str, Any], where: str) -> dict[str, KindNumbers]:
    """Return the numbers in the tables of a terrain file that defines kinds."""
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
            raise _unknown("kind", kind, KINDS)
        shape = _shape(kind, file.shape, f"{where}: shape")
        practice = _shape(kind, file.shape | file.practice, f"{where}: practice")
        numbers[kind] = KindNumbers(file.train, levels, shape, practice)
    return numbers


def _shape(kind: str, table: dict[str, Any], where: str) -> Any:
    """Return the record that a kind's shape is drawn from.

    Raises:
        ConfigError: numbers that no lane can be made of.
    """
    shape = read_record(KINDS[kind].shape, table, where)
    for key, value in table.items():
        numbers = value if isinstance(value, list) else [value]
        if not numbers or numbers[0] <= 0 or numbers != sorted(numbers):
            raise ConfigError(f"{where}: {key} must be above zero and rising, not {value}")
    return shape


def read_record(cls: type, table: dict[str, Any], where: str) -> Any:
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
