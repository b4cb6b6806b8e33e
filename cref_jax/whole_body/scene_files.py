"""Scenes that no policy was trained on: real solids, read from `terrains/ood/*.toml`.

The paper judges policies in twenty MuJoCo scenes with "perforated or hollow foothold surfaces" and
"lateral heterogeneous structures" (Sec. III-A), and shows pictures of some. These twenty are ours.

A scene is a level floor at z = 0, cut by ditches, with boxes and cylinders on it. Robots start on
bare floor and walk along +x; whoever comes to x = `end` within the scene's width has passed it.
"""

import dataclasses
import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import mujoco
import numpy as np
from jaxtyping import Float

from cref_jax import config, geoms
from cref_jax.config import folders
from cref_jax.errors import ConfigError

BORDER = 4.0  # m of floor around the path; assumed: further than the camera sees
DITCH = 1.0  # m, depth of a ditch; as deep as the trained gaps
MOST_SOLIDS = 3000  # of a scene; assumed: a frame's rays still take milliseconds
FLOOR = "floor"  # name of its material

R = TypeVar("R")
Range = tuple[float, float]  # m, from, to
Point = tuple[float, float, float]  # m
Look = Literal["concrete", "stone", "wood", "steel", "rail", "plastic", "rubber", "plant"]
COLOURS: dict[str, tuple[float, float, float]] = {  # red, green, blue
    "concrete": (0.62, 0.62, 0.60),
    "stone": (0.55, 0.50, 0.45),
    "wood": (0.74, 0.56, 0.36),
    "steel": (0.42, 0.47, 0.53),
    "rail": (0.88, 0.68, 0.12),
    "plastic": (0.20, 0.40, 0.62),
    "rubber": (0.17, 0.17, 0.18),
    "plant": (0.33, 0.48, 0.26),
}


class Solid(NamedTuple):
    """A box or a cylinder that stands still."""

    kind: Literal["box", "cylinder"]
    middle: Float[np.ndarray, "3"]  # m
    size: Float[np.ndarray, "3"]  # m: half the sides; or radius, half the length, nothing
    rotation: Float[np.ndarray, "4"]  # quaternion w, x, y, z; a cylinder lies along its z
    look: Look


class Scene(NamedTuple):
    """The ground of a trial: a floor, its ditches and the solids."""

    name: str
    title: str
    end: float  # m along x where it is passed
    width: float  # m, of the path; who leaves it has strayed
    ditches: tuple[Range, ...]  # m along x, rising
    solids: tuple[Solid, ...]
    stops_every_link: bool = True  # see stand_in.Ground

    def add_to(self, spec: mujoco.MjSpec, friction: float) -> None:
        """Add floor and solids to a model."""
        geoms.add_checker(spec, FLOOR, geoms.TONES, repeat=0.5 / geoms.TILE)
        for part in self._floor():
            _add(spec, part, friction).material = FLOOR
        for part in self.solids:
            _add(spec, part, friction).rgba = [*COLOURS[part.look], 1.0]

    def _floor(self) -> list[Solid]:
        """Return the floor between the ditches, and theirs."""
        edges = [-BORDER, *itertools.chain(*self.ditches), self.end + BORDER]
        half = 0.5 * self.width + BORDER
        tops = itertools.cycle([0.0, -DITCH])
        return [
            _box(_Box((a, b), (-half, half), (-DITCH - 0.1, top)))
            for (a, b), top in zip(itertools.pairwise(edges), tops, strict=False)
        ]


@dataclass(frozen=True)
class _Box:
    """A box as a file gives it, and how often: `count` times `by` along each of some ways."""

    x: Range
    y: Range
    z: Range
    tilt: Point = (0.0, 0.0, 0.0)  # deg about its middle: about x, then about y, then about z
    look: Look = "concrete"
    count: tuple[int, ...] = ()
    by: tuple[Point, ...] = ()


@dataclass(frozen=True)
class _Cylinder:
    """A cylinder as a file gives it, and how often."""

    ends: tuple[Point, Point]
    radius: float  # m
    look: Look = "rail"
    count: tuple[int, ...] = ()
    by: tuple[Point, ...] = ()


@dataclass(frozen=True)
class _Place:
    """Where a part of several solids stands, and how often."""

    part: str
    at: Point
    turn: float = 0.0  # deg about z
    count: tuple[int, ...] = ()
    by: tuple[Point, ...] = ()


@dataclass(frozen=True)
class _File:
    """A scene's file."""

    title: str
    end: float
    width: float
    ditches: tuple[Range, ...] = ()
    box: tuple[dict, ...] = ()
    cylinder: tuple[dict, ...] = ()
    place: tuple[dict, ...] = ()
    part: dict | None = None


@dataclass(frozen=True)
class _Part:
    """Solids that are placed together."""

    box: tuple[dict, ...] = ()
    cylinder: tuple[dict, ...] = ()


def directory() -> Path:
    """Return where the scenes are."""
    return folders.data_folder("terrains") / "ood"


def scenes() -> dict[str, Scene]:
    """Return all scenes by their names, in the order of the names."""
    return {path.stem: load(path) for path in sorted(directory().glob("*.toml"))}


def named(name: str) -> Scene:
    """Return one scene.

    Raises:
        ConfigError: there is none of this name, or its file cannot be used.
    """
    known = sorted(path.stem for path in directory().glob("*.toml"))
    if name not in known:
        raise ConfigError(config.unknown("scene", name, known))
    return load(directory() / f"{name}.toml")


def load(path: Path) -> Scene:
    """Return the scene in a file.

    Raises:
        ConfigError: the file cannot be used; the message says what would be right.
    """
    where = path.name
    table = config.load_toml(path)
    _check_finite(table, where)
    file = _record(_File, table, where)
    if not (file.end > 0.0 and file.width > 0.0):
        raise ConfigError(f"{where}: end and width must be above zero")
    edges = [0.0, *itertools.chain(*file.ditches), file.end + BORDER]
    if any(a >= b for a, b in itertools.pairwise(edges)):
        raise ConfigError(f"{where}: ditches must be [[from, to], ...] along x, rising")
    parts = {
        name: _part(table, f"{where}: part.{name}") for name, table in (file.part or {}).items()
    }
    solids = _solids(file, where)
    for number, entry in enumerate(file.place, start=1):
        solids += _placed(_record(_Place, entry, f"{where}: place {number}"), parts, where)
    if len(solids) > MOST_SOLIDS:
        raise ConfigError(f"{where}: {len(solids)} solids, more than {MOST_SOLIDS}")
    return Scene(path.stem, file.title, file.end, file.width, file.ditches, tuple(solids))


def _add(spec: mujoco.MjSpec, solid: Solid, friction: float) -> mujoco.MjsGeom:
    """Add a solid to a model, and return its geom."""
    is_box = solid.kind == "box"
    return spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX if is_box else mujoco.mjtGeom.mjGEOM_CYLINDER,
        pos=solid.middle,
        size=solid.size,
        quat=solid.rotation,
        friction=[friction, 0.005, 0.0001],
        contype=0,
        conaffinity=1,
        group=geoms.GROUND,
    )


def _part(table: Any, where: str) -> list[Solid]:
    if not isinstance(table, dict):
        raise ConfigError(f"{where} must be a table of boxes and cylinders")
    return _solids(_record(_Part, table, where), where)


def _solids(file: _File | _Part, where: str) -> list[Solid]:
    """Return the boxes and cylinders of a file or of a part, each as often as it says."""
    found = []
    for number, table in enumerate(file.box, start=1):
        box = _record(_Box, table, f"{where}: box {number}")
        for side, (a, b) in {"x": box.x, "y": box.y, "z": box.z}.items():
            if a >= b:
                raise ConfigError(
                    f"{where}: box {number}: {side} must be [from, to], rising, not {[a, b]}"
                )
        found += _repeated(_box(box), box, f"{where}: box {number}")
    for number, table in enumerate(file.cylinder, start=1):
        rod = _record(_Cylinder, table, f"{where}: cylinder {number}")
        if not rod.radius > 0.0:
            raise ConfigError(
                f"{where}: cylinder {number}: radius must be above zero, not {rod.radius}"
            )
        if rod.ends[0] == rod.ends[1]:
            raise ConfigError(f"{where}: cylinder {number}: its ends must be apart")
        found += _repeated(_cylinder(rod), rod, f"{where}: cylinder {number}")
    return found


def _box(box: _Box) -> Solid:
    low, high = np.array([box.x, box.y, box.z]).T
    rotation = np.zeros(4)
    mujoco.mju_euler2Quat(rotation, np.radians(box.tilt), "XYZ")
    return Solid("box", 0.5 * (low + high), 0.5 * (high - low), rotation, box.look)


def _cylinder(rod: _Cylinder) -> Solid:
    first, last = np.array(rod.ends)
    length, rotation = float(np.linalg.norm(last - first)), np.zeros(4)
    mujoco.mju_quatZ2Vec(rotation, (last - first) / length)
    size = np.array([rod.radius, 0.5 * length, 0.0])
    return Solid("cylinder", 0.5 * (first + last), size, rotation, rod.look)


def _placed(place: _Place, parts: dict[str, list[Solid]], where: str) -> list[Solid]:
    """Return the solids of a part where it stands."""
    if place.part not in parts:
        raise ConfigError(config.unknown("part", place.part, list(parts), f"{where}: "))
    angle, turn, found = math.radians(place.turn), np.zeros(4), []
    mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), angle)
    for solid in parts[place.part]:
        middle, rotation = np.zeros(3), np.zeros(4)
        mujoco.mju_rotVecQuat(middle, solid.middle, turn)
        mujoco.mju_mulQuat(rotation, turn, solid.rotation)
        moved = solid._replace(middle=middle + place.at, rotation=rotation)
        found += _repeated(moved, place, f"{where}: place '{place.part}'")
    return found


def _repeated(solid: Solid, record: _Box | _Cylinder | _Place, where: str) -> list[Solid]:
    """Return the solid as often as the record says."""
    if len(record.count) != len(record.by) or any(n < 1 for n in record.count):
        raise ConfigError(f"{where}: count and by must be as many, and each count at least 1")
    if math.prod(record.count) > MOST_SOLIDS:
        raise ConfigError(f"{where}: count must not ask for more than {MOST_SOLIDS} solids")
    steps = itertools.product(*(range(n) for n in record.count))
    by = np.array(record.by).reshape(-1, 3)
    return [solid._replace(middle=solid.middle + np.array(step) @ by) for step in steps]


def _record(cls: type[R], table: dict[str, Any], where: str) -> R:
    """Return a table of a file as the record `cls`; what has no default must be there."""
    fields = dataclasses.fields(cls)
    missing = [f.name for f in fields if f.name not in table and f.default is dataclasses.MISSING]
    if missing and table.keys() <= {f.name for f in fields}:
        raise ConfigError(f"{where}: '{missing[0]}' is missing")
    return config.override(object.__new__(cls), table, where=f"{where}: ")


def _check_finite(value: Any, where: str) -> None:
    """Refuse numbers that are none, wherever they stand in a table."""
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            _check_finite(inner, where)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{where}: every number must be finite, not {value}")
