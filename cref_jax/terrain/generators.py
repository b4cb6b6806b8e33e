"""Lane generators: level ground with noise, ramps, steps, trenches or boxes.

Each function generates one kind of lane, of the width and length in `config.Terrain`, from physical
sizes in metres, never from a difficulty. A lane runs along +x, begins with level ground at z = 0,
ends with level ground, and its obstacles span its whole width.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cref_jax import config
from cref_jax.errors import ConfigError

START = 1.5  # m, level ground at the start; assumed: the robot starts at 0.5 to 1 m
END = 1.0  # m, minimum level ground at the end; assumed
PLACES = 32  # start places per lane; assumed
LEVEL = 0.45  # m, level on both sides of a start place; wider than any trench, so never in one

Heights = Float[np.ndarray, "X Y"]  # m
Range = tuple[float, float]  # low, high; uniform


@dataclass(frozen=True)
class Flat:
    """Level ground, without parameters."""


@dataclass(frozen=True)
class Rough:
    """Parameters of uneven ground."""

    spacing: float  # m, between independent heights


@dataclass(frozen=True)
class Slope:
    """Parameters of a ramp up, a level stretch and a ramp down."""

    run: Range  # m, horizontal length of a ramp
    level: Range  # m


@dataclass(frozen=True)
class Stairs:
    """Parameters of two flights with a landing between them."""

    tread: tuple[float, ...]  # m, one is sampled per lane
    steps: tuple[int, int]  # per flight, fewest, most; fewer if the lane is too short
    landing: float  # m


@dataclass(frozen=True)
class Flight:
    """Parameters of one flight."""

    tread: float  # m
    steps: tuple[int, int]  # fewest, most


@dataclass(frozen=True)
class Gap:
    """Parameters of the trenches in a lane."""

    count: int  # at most; limited by the lane's length
    depth: float  # m
    landing: Range  # m, before each trench; at least START before the first


@dataclass(frozen=True)
class Platform:
    """Parameters of the boxes in a lane."""

    count: tuple[int, int]  # fewest, most; limited by the lane's length
    length: Range  # m, per box
    landing: Range  # m, before each box; at least START before the first


def find_level_places(
    profile: Float[np.ndarray, " X"], cell: float
) -> Float[np.ndarray, "places 2"]:
    """Find x and height, m, of PLACES evenly spread level stretches before the last obstacle.

    All NaN if the profile has no obstacle or no such stretch.
    """
    reach = round(LEVEL / cell)
    stretch = np.lib.stride_tricks.sliding_window_view(profile, 2 * reach + 1)
    is_level = np.ptp(stretch, axis=1) == 0.0
    column = np.flatnonzero(is_level) + reach
    changes = np.flatnonzero(np.diff(profile))
    column = column[column < changes[-1]] if changes.size else column[:0]
    if not column.size:
        return np.full((PLACES, 2), np.nan)
    column = column[np.linspace(0, column.size - 1, PLACES).astype(int)]
    return np.stack([(column + 0.5) * cell, profile[column]], axis=1)


def flat(c: config.Terrain, size: float, shape: Flat, rng: np.random.Generator) -> Heights:
    """Generate level ground; `size` is unused."""
    return _extrude(c, [(c.lane_length, 0.0)])


def rough(c: config.Terrain, size: float, shape: Rough, rng: np.random.Generator) -> Heights:
    """Generate uneven ground, `size` metres from its lowest to its highest column."""
    _check_length(c, START + END + 1.0)
    x, y = _column_centres(c)
    coarse_x = np.arange(0.0, c.lane_length + shape.spacing, shape.spacing)
    coarse_y = np.arange(0.0, c.lane_width + shape.spacing, shape.spacing)
    hat = lambda fine, coarse: np.maximum(1.0 - abs(fine[:, None] - coarse) / shape.spacing, 0.0)
    noise = rng.uniform(-1.0, 1.0, (coarse_x.size, coarse_y.size))
    noise = hat(x, coarse_x) @ noise @ hat(y, coarse_y).T
    noise *= np.interp(x, [START, START + 0.5], [0.0, 1.0])[:, None]  # assumed: fades in, and out
    noise *= np.interp(x, [c.lane_length - END - 0.5, c.lane_length - END], [1.0, 0.0])[:, None]
    return (noise * size / np.ptp(noise)).astype(np.float32)


def slope(c: config.Terrain, size: float, shape: Slope, rng: np.random.Generator) -> Heights:
    """Generate a ramp up of gradient `size`, a level stretch and a ramp down to z = 0."""
    run, level = rng.uniform(*shape.run), rng.uniform(*shape.level)
    knots = START + np.cumsum([0.0, run, level, run])
    _check_length(c, knots[-1] + END)
    profile = np.interp(_column_centres(c)[0], knots, [0.0, run * size, run * size, 0.0])
    return np.repeat(profile[:, None], columns(c.lane_width, c), axis=1).astype(np.float32)


def stairs_up(c: config.Terrain, size: float, shape: Stairs, rng: np.random.Generator) -> Heights:
    """Generate a flight of steps up, each `size` metres high, a landing and the flight down."""
    tread = rng.choice(shape.tread)
    room = c.lane_length - START - END - shape.landing
    most = min(shape.steps[1], 1 + int(room / (2.0 * tread) + 1e-6))
    fewest = min(shape.steps[0], most)
    _check_length(c, c.lane_length - room + 2.0 * tread * (shape.steps[0] - 1))
    steps = rng.integers(fewest, most + 1)
    spare = max(0.0, room - 2.0 * tread * (steps - 1))
    start = START + rng.uniform(0.0, min(0.5, spare))  # assumed: not always the same
    flight = [(tread, size * k) for k in range(1, steps)]
    return _extrude(c, [(start, 0.0), *flight, (shape.landing, size * steps), *flight[::-1]])


def stairs_down(c: config.Terrain, size: float, shape: Stairs, rng: np.random.Generator) -> Heights:
    """Generate a flight of steps down, a landing, and the flight back up to z = 0."""
    return -stairs_up(c, size, shape, rng)


def ascent(c: config.Terrain, size: float, shape: Flight, rng: np.random.Generator) -> Heights:
    """Generate one flight of steps up, each `size` metres high, and level ground above it."""
    steps = rng.integers(shape.steps[0], shape.steps[1] + 1)
    start = START + rng.uniform(0.0, 0.5)  # assumed: not always the same
    flight = [(start, 0.0), *((shape.tread, size * k) for k in range(1, steps))]
    _check_length(c, _total_length(flight, c) + END)
    return _extrude(c, flight, last=size * steps)


def descent(c: config.Terrain, size: float, shape: Flight, rng: np.random.Generator) -> Heights:
    """Generate one flight of steps down, and level ground below it."""
    return -ascent(c, size, shape, rng)


def gap(c: config.Terrain, size: float, shape: Gap, rng: np.random.Generator) -> Heights:
    """Generate level ground cut by equal trenches, `size` metres wide."""
    sections = []
    for k in range(shape.count):
        trench = [(_sample_landing(shape.landing, k, rng), 0.0), (size, -shape.depth)]
        if k > 0 and _total_length(sections + trench, c) > c.lane_length - END:
            break
        sections += trench
    _check_length(c, _total_length(sections, c) + END)
    return _extrude(c, sections)


def platform(c: config.Terrain, size: float, shape: Platform, rng: np.random.Generator) -> Heights:
    """Generate level ground with boxes, `size` metres high, to step onto and off."""
    sections = []
    for k in range(shape.count[1]):
        landing = _sample_landing(shape.landing, k, rng)
        box = [(landing, 0.0), (rng.uniform(*shape.length), size)]
        if k >= shape.count[0] and _total_length(sections + box, c) > c.lane_length - END:
            break
        sections += box
    _check_length(c, _total_length(sections, c) + END)
    return _extrude(c, sections)


class Kind(NamedTuple):
    """A lane generator and the type of its shape parameters."""

    heights: Callable[..., Heights]
    shape: type
    is_gradient: bool = False  # its size is m/m and not m


KINDS: dict[str, Kind] = {
    "flat": Kind(flat, Flat),
    "rough": Kind(rough, Rough),
    "slope": Kind(slope, Slope, is_gradient=True),
    "stairs_up": Kind(stairs_up, Stairs),
    "stairs_down": Kind(stairs_down, Stairs),
    "ascent": Kind(ascent, Flight),
    "descent": Kind(descent, Flight),
    "gap": Kind(gap, Gap),
    "platform": Kind(platform, Platform),
}


def size_unit(kind: str) -> str:
    """Return the unit in which a size is shown, hundredths of that in which it is given."""
    return "%" if kind in KINDS and KINDS[kind].is_gradient else "cm"


def format_size(kind: str, size: float) -> str:
    """Format a size: a gradient in %, any other size in cm."""
    return f"{100.0 * size:.3g} {size_unit(kind)}"


def columns(metres: float, c: config.Terrain) -> int:
    """Convert a length, m, to columns, rounded up so that no obstacle becomes easier."""
    return int(np.ceil(metres / c.cell - 1e-6))


def _column_centres(c: config.Terrain) -> tuple[np.ndarray, np.ndarray]:
    """Compute the centres of a lane's columns along and across it, m from its corner."""
    middles = lambda metres: (np.arange(columns(metres, c)) + 0.5) * c.cell
    return middles(c.lane_length), middles(c.lane_width)


def _sample_landing(span: Range, number: int, rng: np.random.Generator) -> float:
    """Sample the length of level ground before an obstacle, m; number 0 is the first."""
    return max(rng.uniform(*span), 0.0 if number else START)


def _extrude(c: config.Terrain, sections: list[tuple[float, float]], last: float = 0.0) -> Heights:
    """Extrude (length, height) sections, m, from the start; then level at `last` to the end."""
    profile = np.concatenate([np.full(columns(length, c), z) for length, z in sections])
    _check_length(c, profile.size * c.cell)
    rest = columns(c.lane_length, c) - profile.size
    profile = np.pad(profile, (0, rest), constant_values=last)
    return np.repeat(profile[:, None], columns(c.lane_width, c), axis=1).astype(np.float32)


def _total_length(sections: list[tuple[float, float]], c: config.Terrain) -> float:
    """Compute the length of (length, height) sections in whole columns, m."""
    return sum(columns(length, c) for length, _ in sections) * c.cell


def _check_length(c: config.Terrain, needed: float) -> None:
    """Check that a lane is long enough for its obstacles.

    Raises:
        ConfigError: it is shorter than `needed`, m.
    """
    if needed > c.lane_length + 1e-6:
        raise ConfigError(f"lane_length is {c.lane_length:g} m, but {needed:.2f} m are needed")
