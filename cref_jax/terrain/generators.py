"""What lies in a lane: level ground, and on it noise, ramps, steps, trenches or boxes.

Each function draws one kind of lane, as wide and as long as `config.Terrain` says, from physical
sizes in metres, never from a difficulty. A lane begins with level ground at z = 0, ends with level
ground, leads along +x, and what stands or lies in it spans its whole width.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cref_jax import config
from cref_jax.errors import ConfigError

START = 1.5  # m, level ground at the start; assumed: the robot is put down at 0.5 to 1 m
END = 1.0  # m, level ground at the end, at least; assumed
PLACES = 32  # of a lane, that robots may start from; assumed
LEVEL = 0.45  # m, level ground before and behind such a place; wider than any trench, so not in one

Heights = Float[np.ndarray, "X Y"]  # m
Range = tuple[float, float]  # from, to; uniform


@dataclass(frozen=True)
class Flat:
    """Level ground has no numbers."""


@dataclass(frozen=True)
class Rough:
    """Numbers of uneven ground."""

    spacing: float  # m, between independent heights


@dataclass(frozen=True)
class Slope:
    """Numbers of a ramp up, a level stretch and a ramp down."""

    run: Range  # m, horizontal length of a ramp
    level: Range  # m


@dataclass(frozen=True)
class Stairs:
    """Numbers of two flights with a landing between them."""

    tread: tuple[float, ...]  # m, one of these for the whole lane
    steps: tuple[int, int]  # of a flight, from, to; fewer where the lane is too short
    landing: float  # m


@dataclass(frozen=True)
class Flight:
    """Numbers of one flight."""

    tread: float  # m
    steps: tuple[int, int]  # from, to


@dataclass(frozen=True)
class Gap:
    """Numbers of the trenches in a lane."""

    count: int  # at most: as many as the lane has room for
    depth: float  # m
    landing: Range  # m, before each trench; START at least before the first


@dataclass(frozen=True)
class Platform:
    """Numbers of the boxes in a lane."""

    count: tuple[int, int]  # from, to: as many as the lane has room for
    length: Range  # m, of a box
    landing: Range  # m, before each box; START at least before the first


def level_places(profile: Float[np.ndarray, " X"], cell: float) -> Float[np.ndarray, "places 2"]:
    """Return x and height of PLACES level stretches of a lane with this profile, in even spread."""
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
    """Return level ground; it has no size."""
    return _across(c, [(c.lane_length, 0.0)])


def rough(c: config.Terrain, size: float, shape: Rough, rng: np.random.Generator) -> Heights:
    """Return uneven ground, `size` metres from its lowest to its highest column."""
    _check_length(c, START + END + 1.0)
    x, y = _centres(c)
    coarse_x = np.arange(0.0, c.lane_length + shape.spacing, shape.spacing)
    coarse_y = np.arange(0.0, c.lane_width + shape.spacing, shape.spacing)
    hat = lambda fine, coarse: np.maximum(1.0 - abs(fine[:, None] - coarse) / shape.spacing, 0.0)
    noise = rng.uniform(-1.0, 1.0, (coarse_x.size, coarse_y.size))
    noise = hat(x, coarse_x) @ noise @ hat(y, coarse_y).T
    noise *= np.interp(x, [START, START + 0.5], [0.0, 1.0])[:, None]  # assumed: fades in, and out
    noise *= np.interp(x, [c.lane_length - END - 0.5, c.lane_length - END], [1.0, 0.0])[:, None]
    return (noise * size / np.ptp(noise)).astype(np.float32)


def slope(c: config.Terrain, size: float, shape: Slope, rng: np.random.Generator) -> Heights:
    """Return a ramp up of gradient `size`, a level stretch and a ramp down to z = 0."""
    run, level = rng.uniform(*shape.run), rng.uniform(*shape.level)
    knots = START + np.cumsum([0.0, run, level, run])
    _check_length(c, knots[-1] + END)
    profile = np.interp(_centres(c)[0], knots, [0.0, run * size, run * size, 0.0])
    return np.repeat(profile[:, None], columns(c.lane_width, c), axis=1).astype(np.float32)


def stairs_up(c: config.Terrain, size: float, shape: Stairs, rng: np.random.Generator) -> Heights:
    """Return a flight of steps up, each rising `size` metres, a landing, and the flight down."""
    tread = rng.choice(shape.tread)
    room = c.lane_length - START - END - shape.landing
    most = min(shape.steps[1], 1 + int(room / (2.0 * tread) + 1e-6))
    fewest = min(shape.steps[0], most)
    _check_length(c, c.lane_length - room + 2.0 * tread * (shape.steps[0] - 1))
    steps = rng.integers(fewest, most + 1)
    spare = max(0.0, room - 2.0 * tread * (steps - 1))
    start = START + rng.uniform(0.0, min(0.5, spare))  # assumed: not always the same
    flight = [(tread, size * k) for k in range(1, steps)]
    return _across(c, [(start, 0.0), *flight, (shape.landing, size * steps), *flight[::-1]])


def stairs_down(c: config.Terrain, size: float, shape: Stairs, rng: np.random.Generator) -> Heights:
    """Return a flight of steps down, a landing below, and the flight up to the level before."""
    return -stairs_up(c, size, shape, rng)


def ascent(c: config.Terrain, size: float, shape: Flight, rng: np.random.Generator) -> Heights:
    """Return one flight of steps up, each rising `size` metres, and the level above it."""
    steps = rng.integers(shape.steps[0], shape.steps[1] + 1)
    start = START + rng.uniform(0.0, 0.5)  # assumed: not always the same
    flight = [(start, 0.0), *((shape.tread, size * k) for k in range(1, steps))]
    _check_length(c, _length(flight, c) + END)
    return _across(c, flight, last=size * steps)


def descent(c: config.Terrain, size: float, shape: Flight, rng: np.random.Generator) -> Heights:
    """Return one flight of steps down, and the level below it."""
    return -ascent(c, size, shape, rng)


def gap(c: config.Terrain, size: float, shape: Gap, rng: np.random.Generator) -> Heights:
    """Return level ground cut by equal trenches, `size` metres wide."""
    sections = []
    for k in range(shape.count):
        trench = [(_landing(shape.landing, k, rng), 0.0), (size, -shape.depth)]
        if k > 0 and _length(sections + trench, c) > c.lane_length - END:
            break
        sections += trench
    _check_length(c, _length(sections, c) + END)
    return _across(c, sections)


def platform(c: config.Terrain, size: float, shape: Platform, rng: np.random.Generator) -> Heights:
    """Return level ground with boxes on it, `size` metres high, to step up and down."""
    sections = []
    for k in range(shape.count[1]):
        landing = _landing(shape.landing, k, rng)
        box = [(landing, 0.0), (rng.uniform(*shape.length), size)]
        if k >= shape.count[0] and _length(sections + box, c) > c.lane_length - END:
            break
        sections += box
    _check_length(c, _length(sections, c) + END)
    return _across(c, sections)


class Kind(NamedTuple):
    """A shape and the numbers it needs beside its size."""

    heights: Callable[..., Heights]
    shape: type


KINDS: dict[str, Kind] = {
    "flat": Kind(flat, Flat),
    "rough": Kind(rough, Rough),
    "slope": Kind(slope, Slope),
    "stairs_up": Kind(stairs_up, Stairs),
    "stairs_down": Kind(stairs_down, Stairs),
    "ascent": Kind(ascent, Flight),
    "descent": Kind(descent, Flight),
    "gap": Kind(gap, Gap),
    "platform": Kind(platform, Platform),
}


def extent(kind: str, size: float) -> str:
    """Return a size for people: that of a slope is its gradient, all others are lengths."""
    return f"{100.0 * size:.3g} {'%' if kind == 'slope' else 'cm'}"


def columns(metres: float, c: config.Terrain) -> int:
    """Return how many columns a length takes, rounded up: an obstacle is never made easier."""
    return int(np.ceil(metres / c.cell - 1e-6))


def _centres(c: config.Terrain) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles of a lane's columns along and across it, from its corner, m."""
    middles = lambda metres: (np.arange(columns(metres, c)) + 0.5) * c.cell
    return middles(c.lane_length), middles(c.lane_width)


def _landing(span: Range, number: int, rng: np.random.Generator) -> float:
    """Return the length of level ground before an obstacle of this number, m."""
    return max(rng.uniform(*span), 0.0 if number else START)


def _across(c: config.Terrain, sections: list[tuple[float, float]], last: float = 0.0) -> Heights:
    """Return the lane made of (length, height) sections from the start on, then level at `last`."""
    profile = np.concatenate([np.full(columns(length, c), z) for length, z in sections])
    _check_length(c, profile.size * c.cell)
    rest = columns(c.lane_length, c) - profile.size
    profile = np.pad(profile, (0, rest), constant_values=last)
    return np.repeat(profile[:, None], columns(c.lane_width, c), axis=1).astype(np.float32)


def _length(sections: list[tuple[float, float]], c: config.Terrain) -> float:
    """Return the length of (length, height) sections in whole columns, m."""
    return sum(columns(length, c) for length, _ in sections) * c.cell


def _check_length(c: config.Terrain, needed: float) -> None:
    """Refuse a lane that is too short for what it should hold."""
    if needed > c.lane_length + 1e-6:
        raise ConfigError(f"lane_length is {c.lane_length:g} m, but {needed:.2f} m are needed")
