"""Scenes of solids that no policy was trained on, read from `terrains/ood/*.toml`.

The paper evaluates policies in twenty MuJoCo scenes with "perforated or hollow foothold surfaces"
and "lateral heterogeneous structures" (Sec. III-A) and shows some of them. These twenty are ours.

A scene is a level floor at z = 0, cut by ditches, with boxes and cylinders on it. Robots start on
bare floor and walk along +x; a robot that reaches x = `end` within the scene's width passes.
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

BORDER = 4.0  # m of floor around the path; assumed: beyond the camera's range
DITCH = 1.0  # m, depth of a ditch; as deep as the trained gaps
MOST_SOLIDS = 3000  # per scene; assumed: ray-casting a frame still takes milliseconds
FLOOR = "floor"  # name of the floor's material

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
    """A static box or cylinder."""

    kind: Literal["box", "cylinder"]
    middle: Float[np.ndarray, "3"]  # m
    size: Float[np.ndarray, "3"]  # m: half the sides; or radius, half the length, nothing
    rotation: Float[np.ndarray, "4"]  # quaternion w, x, y, z; a cylinder lies along its z
    look: Look


class Scene(NamedTuple):
    """The ground of a trial: a floor, its ditches and the solids."""

    name: str
    title: str
    end: float  # m along x at which the scene is passed
    width: float  # m, of the path; a robot outside has strayed
    ditches: tuple[Range, ...]  # m along x, ascending
    solids: tuple[Solid, ...]
    stops_every_link: bool = True  # see ground.Ground

    def add_to(self, spec: mujoco.MjSpec, friction: float) -> None:
        """Add the floor and the solids to a model."""
        geoms.add_checker(spec, FLOOR, geoms.TONES, repeat=0.5 / geoms.TILE)
        for part in self._floor():
            _add_solid(spec, part, friction).material = FLOOR
        for part in self.solids:
            _add_solid(spec, part, friction).rgba = [*COLOURS[part.look], 1.0]

    def _floor(self) -> list[Solid]:
        """Build the floor between the ditches and the floor of each ditch."""
        edges = [-BORDER, *itertools.chain(*self.ditches), self.end + BORDER]
        half = 0.5 * self.width + BORDER
        tops = itertools.cycle([0.0, -DITCH])
        return [
            _build_box(_Box((a, b), (-half, half), (-DITCH - 0.1, top)))
            for (a, b), top in zip(itertools.pairwise(edges), tops, strict=False)
        ]


@dataclass(frozen=True)
class _Box:
    """A box in a file, repeated `count[i]` times at spacing `by[i]` for each i."""

    x: Range
    y: Range
    z: Range
    tilt: Point = (0.0, 0.0, 0.0)  # deg about its centre: about x, then y, then z
    look: Look = "concrete"
    count: tuple[int, ...] = ()
    by: tuple[Point, ...] = ()


@dataclass(frozen=True)
class _Cylinder:
    """A cylinder in a file, repeated like a box."""

    ends: tuple[Point, Point]
    radius: float  # m
    look: Look = "rail"
    count: tuple[int, ...] = ()
    by: tuple[Point, ...] = ()


@dataclass(frozen=True)
class _Place:
    """The position of a part of several solids, repeated like a box."""

    part: str
    at: Point
    turn: float = 0.0  # deg about z
    count: tuple[int, ...] = ()
    by: tuple[Point, ...] = ()


@dataclass(frozen=True)
class _File:
    """The contents of a scene file."""

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
    """Solids placed together."""

    box: tuple[dict, ...] = ()
    cylinder: tuple[dict, ...] = ()


def directory() -> Path:
    """Return the folder of the scene files."""
    return folders.data_folder("terrains") / "ood"


def load_all() -> dict[str, Scene]:
    """Load all scenes by name, in the order of the names."""
    return {path.stem: load(path) for path in sorted(directory().glob("*.toml"))}


def load_named(name: str) -> Scene:
    """Load the scene of this name.

    Raises:
        ConfigError: there is no such scene, or its file cannot be used.
    """
    known = sorted(path.stem for path in directory().glob("*.toml"))
    if name not in known:
        raise ConfigError(config.describe_unknown("scene", name, known))
    return load(directory() / f"{name}.toml")


def load(path: Path) -> Scene:
    """Load the scene in a file.

    Raises:
        ConfigError: the file cannot be used; the message states what is expected.
    """
    where = path.name
    table = config.load_toml(path)
    config.check_finite(table, where)
    file = _read_record(_File, table, where)
    if not (file.end > 0.0 and file.width > 0.0):
        raise ConfigError(f"{where}: end and width must be above zero")
    edges = [0.0, *itertools.chain(*file.ditches), file.end + BORDER]
    if any(a >= b for a, b in itertools.pairwise(edges)):
        raise ConfigError(f"{where}: ditches must be [[from, to], ...] along x, ascending")
    parts = {
        name: _read_part(table, f"{where}: part.{name}")
        for name, table in (file.part or {}).items()
    }
    solids = _read_solids(file, where)
    for number, entry in enumerate(file.place, start=1):
        solids += _place_part(_read_record(_Place, entry, f"{where}: place {number}"), parts, where)
    if len(solids) > MOST_SOLIDS:
        raise ConfigError(f"{where}: {len(solids)} solids, more than {MOST_SOLIDS}")
    return Scene(path.stem, file.title, file.end, file.width, file.ditches, tuple(solids))


def _add_solid(spec: mujoco.MjSpec, solid: Solid, friction: float) -> mujoco.MjsGeom:
    """Add a solid to a model and return its geom."""
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


def _read_part(table: Any, where: str) -> list[Solid]:
    if not isinstance(table, dict):
        raise ConfigError(f"{where} must be a table of boxes and cylinders")
    return _read_solids(_read_record(_Part, table, where), where)


def _read_solids(file: _File | _Part, where: str) -> list[Solid]:
    """Read the boxes and cylinders of a file or part, with their repetitions."""
    solids = []
    for number, table in enumerate(file.box, start=1):
        box = _read_record(_Box, table, f"{where}: box {number}")
        for side, (a, b) in {"x": box.x, "y": box.y, "z": box.z}.items():
            if a >= b:
                raise ConfigError(
                    f"{where}: box {number}: {side} must be [from, to], ascending, not {[a, b]}"
                )
        solids += _repeat_solid(_build_box(box), box, f"{where}: box {number}")
    for number, table in enumerate(file.cylinder, start=1):
        rod = _read_record(_Cylinder, table, f"{where}: cylinder {number}")
        if not rod.radius > 0.0:
            raise ConfigError(
                f"{where}: cylinder {number}: radius must be above zero, not {rod.radius}"
            )
        if rod.ends[0] == rod.ends[1]:
            raise ConfigError(f"{where}: cylinder {number}: its ends must differ")
        solids += _repeat_solid(_build_cylinder(rod), rod, f"{where}: cylinder {number}")
    return solids


def _build_box(box: _Box) -> Solid:
    low, high = np.array([box.x, box.y, box.z]).T
    rotation = np.zeros(4)
    mujoco.mju_euler2Quat(rotation, np.radians(box.tilt), "XYZ")
    return Solid("box", 0.5 * (low + high), 0.5 * (high - low), rotation, box.look)


def _build_cylinder(rod: _Cylinder) -> Solid:
    first, last = np.array(rod.ends)
    length, rotation = float(np.linalg.norm(last - first)), np.zeros(4)
    mujoco.mju_quatZ2Vec(rotation, (last - first) / length)
    size = np.array([rod.radius, 0.5 * length, 0.0])
    return Solid("cylinder", 0.5 * (first + last), size, rotation, rod.look)


def _place_part(place: _Place, parts: dict[str, list[Solid]], where: str) -> list[Solid]:
    """Place the solids of a part."""
    if place.part not in parts:
        raise ConfigError(config.describe_unknown("part", place.part, list(parts), f"{where}: "))
    angle, turn, solids = math.radians(place.turn), np.zeros(4), []
    mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), angle)
    for solid in parts[place.part]:
        middle, rotation = np.zeros(3), np.zeros(4)
        mujoco.mju_rotVecQuat(middle, solid.middle, turn)
        mujoco.mju_mulQuat(rotation, turn, solid.rotation)
        moved = solid._replace(middle=middle + place.at, rotation=rotation)
        solids += _repeat_solid(moved, place, f"{where}: place '{place.part}'")
    return solids


def _repeat_solid(solid: Solid, record: _Box | _Cylinder | _Place, where: str) -> list[Solid]:
    """Repeat a solid along the directions `by` of its record."""
    if len(record.count) != len(record.by) or any(n < 1 for n in record.count):
        raise ConfigError(
            f"{where}: count and by must have equal length, and each count be at least 1"
        )
    if math.prod(record.count) > MOST_SOLIDS:
        raise ConfigError(f"{where}: count must not give more than {MOST_SOLIDS} solids")
    steps = itertools.product(*(range(n) for n in record.count))
    by = np.array(record.by).reshape(-1, 3)
    return [solid._replace(middle=solid.middle + np.array(step) @ by) for step in steps]


def _read_record(cls: type[R], table: dict[str, Any], where: str) -> R:
    """Read a table as the record `cls`; fields without a default are required."""
    fields = dataclasses.fields(cls)
    missing = [f.name for f in fields if f.name not in table and f.default is dataclasses.MISSING]
    if missing and table.keys() <= {f.name for f in fields}:
        raise ConfigError(f"{where}: '{missing[0]}' is missing")
    return config.override(object.__new__(cls), table, where=f"{where}: ")
