"""Where feet come down on stairs (Sec. III-B): `python experiments/foothold_lab.py`.

    python experiments/foothold_lab.py --policies ours=policies/stairs fcqr=runs/F nofr=runs/N

draws one row a policy; `--policy` or `--run` names a single one. Writes footholds_on_stairs.png and
footholds_on_stairs.csv (a row a touchdown). 64 robots take one to two minutes a policy on 4 busy
cores, 25 s of which are compilation.

Half the robots meet a flight up, half a flight down: hard stairs, 20 cm rise, 30 cm tread
(terrains/flight.toml).
A touchdown is that of either foot on a tread, after at least AIR in the air, of a robot that has
not failed. Its position is that of the sole's centre, from the tread's nosing (0) towards its riser
(30 cm), on the way up as on the way down. MAD is the median absolute deviation from the median.
d_xz is what the foothold reward looks at: how far the nearest candidate is that was frozen at
liftoff, across the lane not counted; none where no window was accepted.

A riser collision begins when a contact sphere touches a riser that faces the robot, or its nosing:
the surface nearest to the sphere is nearer than its radius, and its normal points back along the
lane, within 45 degrees. That happens on the way up alone. Apart are counted the spheres of the foot
(the ankle-roll link) and those on the front of the shank, 9 cm above the ankle and higher; the
ankle itself has none. Looked at once a control step, 50 times a second.

The paper, in descent: 1.4 cm, 2.8 cm with FCQR, 9.8 cm without a foothold reward; and no
ankle-riser collisions in ascent. A policy that has not learnt stairs leaves empty panels and an
empty table.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro
from jaxtyping import Array, Bool, Float
from matplotlib.axes import Axes

from cref_jax import cli, terrain
from cref_jax.env import footholds
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.evaluation import protocol, recorder
from cref_jax.evaluation.recorder import Moment, Watched
from cref_jax.policy import sources
from cref_jax.robot import kinematics
from cref_jax.system import jax_setup
from cref_jax.terrain import cross_section, lanes

KINDS = ("ascent", "descent")  # of lane, one flight each
TREAD = 0.30  # m, terrains/flight.toml
AIR = 0.06  # s; assumed: three control steps, a shorter time is a foot that rocks
REACH = 0.1  # m, half a sole
TILT = 0.05  # m from a tread's height to the sole's centre, at most; assumed: tilted by 30 degrees
FACING = -0.7  # x of a riser's normal, at most: within 45 degrees of -x
BIN = 0.01  # m
PAPER = {"ours": 1.4, "FCQR": 2.8, "NoFR": 9.8}  # cm, MAD in descent, Sec. III-B
NONE = "no touchdown"
WAYS = {cross_section.UP: "ascent", cross_section.DOWN: "descent"}
COLUMNS = ("policy", "way", "robot", "foot", "time_s", "position_cm", "d_xz_cm")


@dataclass(frozen=True)
class Options(recorder.Options):
    """Compare where policies put their feet on stairs."""

    policies: Annotated[tuple[str, ...], tyro.conf.arg(metavar="LABEL=PATH ...")] = ()
    """exported policies (a directory or .zip) or runs, one row of the picture each"""
    policy: Path | None = None
    """one exported policy"""
    run: Path | None = None
    """one run; the newest when nothing is named, or the bundled policy where there is none"""
    rise: float = 0.20
    """m, of a step"""
    seconds: float = 40.0
    """length of a trial"""
    out: Path = Path("footholds_on_stairs.png")
    """the picture to write; the table stands beside it"""


class Step(NamedTuple):
    """What is kept of a control step of E robots, after it."""

    base_x: Float[Array, " E"]  # m
    sole: Float[Array, "E F 3"]  # m, centre of the sole
    touchdown: Bool[Array, "E F"]
    air_time: Float[Array, "E F"]  # s in the air before this step
    distance: Float[Array, "E F"]  # m, d_xz; inf where there is no candidate
    foot_riser: Bool[Array, "E F"]  # the foot touches a riser that faces the robot
    shank_riser: Bool[Array, "E F"]


class Way(NamedTuple):
    """What R robots did on the flights of one direction."""

    robots: int  # on the lanes
    reached: int  # robots that came onto such a flight
    crossed: int  # robots that came to the end of one
    robot: np.ndarray  # of each touchdown: its number
    foot: np.ndarray  # 0 left, 1 right
    time: np.ndarray  # s
    position: np.ndarray  # m
    distance: np.ndarray  # m, d_xz; inf where there was no candidate
    foot_riser: int  # collisions
    shank_riser: int
    collided: int  # robots that had one

    def line(self) -> str:
        """Return the touchdowns in one line for people."""
        said = f"{self.came()}, {len(self.position)} touchdowns"
        if not len(self.position):
            return said
        nearest = 100 * np.median(self.distance)
        return (
            f"{said}, median {100 * np.median(self.position):.1f} cm, "
            f"MAD {100 * deviation(self.position):.1f} cm, median d_xz "
            + (f"{nearest:.1f} cm" if np.isfinite(nearest) else "none: half had no candidate")
        )

    def came(self) -> str:
        """Return how many robots came onto the flight, and how many over it."""
        return f"{self.reached} of {self.robots} robots came here, {self.crossed} to its end"

    def collisions(self) -> str:
        """Return how often a riser was touched."""
        return (
            f"{self.collided} robots touched a riser: {self.foot_riser} times with a foot, "
            f"{self.shank_riser} with a shank"
        )


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a mistake in it is one line and exit code 2."""
    options = tyro.cli(Options, args=arguments)
    with cli.one_line_errors(options.debug):
        jax_setup.prepare()
        out = cli.writable(options.out, ".png")
        found = {label: measured(path, options) for label, path in named(options).items()}
        for label, ways in found.items():
            for way, name in WAYS.items():
                print(f"{label}, {name}: {ways[way].line()}")
            print(f"{label}, ascent: {ways[cross_section.UP].collisions()}")
            if not any(len(ways[way].position) for way in WAYS):
                print(f"{label}: no touchdown on these stairs, so nothing to draw")
        recorder.write_table(out.with_suffix(".csv"), COLUMNS, rows(found))
        draw(out, found, options)
        print(f"wrote {out} and {out.with_suffix('.csv')}")


def named(options: Options) -> dict[str, Path]:
    """Return the policy or run of each label.

    Raises:
        ConfigError: a label is missing or there twice, or --policies are not all.
    """
    if not options.policies:
        source = sources.resolve_policy(options.run, options.policy)
        return {source.stem: source}
    if options.run or options.policy:
        raise ConfigError("give --policies, or one --policy or --run")
    pairs = [text.partition("=") for text in options.policies]
    labels = [label for label, _, _ in pairs]
    if not all(label and path for label, _, path in pairs) or len(set(labels)) < len(labels):
        raise ConfigError(f"--policies are different LABEL=PATH, not {' '.join(options.policies)}")
    return {label: Path(path) for label, _, path in pairs}


def measured(path: Path, options: Options) -> dict[int, Way]:
    """Return what one policy does on the flights up and on those down."""
    policy, world = recorder.open_policy(None, path, options.engine)
    sizes = {kind: (options.rise,) for kind in KINDS}
    stairs = lanes.grid(policy.config.terrain, sizes, protocol.LANE_SEEDS)
    world = recorder.place_robots(policy.config, world, stairs, options.command)
    robots = recorder.begin(world, options.seed, recorder.default_num_envs(options.num_envs, 2048))
    steps = recorder.steps_of(options.seconds, policy.config)
    watched = recorder.watch(world, policy.train, robots, steps, look)
    return summed(world, watched)


def look(world: World, moment: Moment) -> Step:
    """Return where the feet are, and what touches a riser."""
    state = moment.after.env
    soles, hits = jax.vmap(lambda s: _feet(world, s))(state)
    spheres = world.physics.robot.spheres
    left = np.array([name.startswith("left") for name in spheres.names])
    of = lambda which: jnp.stack(
        [hits[:, which & side].any(axis=1) for side in (left, ~left)], axis=1
    )
    return Step(
        base_x=state.body.qpos[:, 0],
        sole=soles,
        touchdown=moment.outcome.measures.touchdown,
        air_time=moment.robots.env.gait.air_time,
        distance=moment.outcome.measures.foothold_distance,
        foot_riser=of(spheres.foot >= 0),
        shank_riser=of(spheres.foot < 0),
    )


def _feet(world: World, state) -> tuple[Float[Array, "F 3"], Bool[Array, " S"]]:
    """Return the centres of one robot's soles, m, and which spheres touch a riser."""
    robot, links = world.physics.robot, world.physics.links(state.body)
    ground = world.lanes.tile(state.level, state.kind)
    centres = kinematics.points(links, robot.spheres.body, robot.spheres.position)
    _, normal, distance = jax.vmap(lambda p: terrain.closest_point(ground, p))(centres)
    hits = (distance < robot.spheres.radius) & (normal[:, 0] < FACING)
    return footholds.soles(links, robot).centre, hits


def summed(world: World, watched: Watched) -> dict[int, Way]:
    """Return what was seen on the flights of each direction."""
    alive, seen = watched.alive, watched.seen
    period = world.config.physics.control_period
    t, robot, foot = np.nonzero(seen.touchdown & alive[..., None] & (seen.air_time >= AIR))
    sole = seen.sole[t, robot, foot]
    flight, position = np.zeros(len(t), int), np.zeros(len(t))
    lane, levels = recorder.round_robin_lanes(world.lanes, alive.shape[1])
    onto, over = np.zeros_like(alive), np.zeros_like(alive)
    for e, (kind, level) in enumerate(zip(lane, levels, strict=True)):
        stairs, mine = cross_section.of_lane(world.lanes.tile(level, kind)), robot == e
        place = cross_section.place_on_treads(stairs, sole[mine, 0], sole[mine, 2], REACH, TILT)
        flight[mine], position[mine] = place.flight, place.position
        treads, x = np.flatnonzero(stairs.flight), seen.base_x[:, e]
        onto[:, e] = alive[:, e] & (x > stairs.left[treads[0]])
        over[:, e] = alive[:, e] & (x > stairs.right[treads[-1]])
    foot_hits, shank_hits = (
        recorder.onsets(flag & alive[..., None]) for flag in (seen.foot_riser, seen.shank_riser)
    )
    ways = {}
    for kind, way in enumerate(WAYS):
        landed, there = flight == way, lane == kind
        ways[way] = Way(
            robots=int(there.sum()),
            reached=int(onto[:, there].any(axis=0).sum()),
            crossed=int(over[:, there].any(axis=0).sum()),
            robot=robot[landed],
            foot=foot[landed],
            time=(t[landed] + 1) * period,
            position=position[landed],
            distance=seen.distance[t[landed], robot[landed], foot[landed]],
            foot_riser=int(foot_hits[:, there].sum()),
            shank_riser=int(shank_hits[:, there].sum()),
            collided=int((foot_hits | shank_hits)[:, there].any(axis=(0, 2)).sum()),
        )
    return ways


def deviation(x: Float[np.ndarray, " n"]) -> float:
    """Return the median absolute deviation from the median."""
    return float(np.median(np.abs(x - np.median(x))))


def rows(found: dict[str, dict[int, Way]]) -> Iterator[tuple]:
    """Yield a row of the table for each touchdown."""
    for label, ways in found.items():
        for way, name in WAYS.items():
            w = ways[way]
            columns = (w.robot, w.foot, w.time, w.position, w.distance)
            for n, foot, time, position, d in zip(*columns, strict=True):
                away = 100 * d if np.isfinite(d) else ""
                yield label, name, n, ("left", "right")[foot], time, 100 * position, away


def draw(out: Path, found: dict[str, dict[int, Way]], options: Options) -> None:
    """Draw a row of histograms a policy, and the deviations beside those of the paper."""
    size = (11, 1.2 + 2.4 * len(found))
    figure = plt.figure(figsize=size, constrained_layout=True)
    grid = figure.add_gridspec(len(found), 3, width_ratios=(3, 3, 2))
    for row, (label, ways) in enumerate(found.items()):
        for column, (way, name) in enumerate(WAYS.items()):
            axis = figure.add_subplot(grid[row, column])
            histogram(axis, ways[way], f"C{row}")
            axis.set_title(f"{label}, {name}", fontsize=10)
            if row == len(found) - 1:
                axis.set_xlabel("from nosing (0) towards riser, cm")
    deviations(figure.add_subplot(grid[:, 2]), found)
    figure.suptitle(
        f"Where the sole's centre comes down, both feet: rise {100 * options.rise:g} cm, "
        f"tread {100 * TREAD:g} cm, {options.command:g} m/s",
        fontsize=11,
    )
    figure.savefig(out, dpi=90)


def histogram(axis: Axes, way: Way, colour: str) -> None:
    """Draw the touchdowns between nosing and riser, or say that there are none."""
    edges = np.arange(-10.0, 100 * TREAD + 10.5, 100 * BIN)
    for x in (0.0, 100 * TREAD):
        axis.axvline(x, color="0.5", lw=0.8, ls="--")
    axis.set(xlim=(edges[0], edges[-1]), ylabel="share of touchdowns")
    said = [way.came()]
    if len(way.position):
        weights = np.full(len(way.position), 1.0 / len(way.position))
        axis.hist(100 * way.position, edges, weights=weights, color=colour, alpha=0.8)
        said += [
            f"{len(way.position)} touchdowns",
            f"MAD {100 * deviation(way.position):.1f} cm",
        ]
    else:
        axis.set(yticks=[], ylim=(0, 1))
        said += [NONE]
    if way.collided:
        said += way.collisions().split(": ")
    axis.set_ylim(top=1.7 * axis.get_ylim()[1] if len(way.position) else 1.0)
    axis.text(
        0.98, 0.96, "\n".join(said), transform=axis.transAxes, ha="right", va="top", size=8,
        bbox={"color": "w", "alpha": 0.8, "pad": 1.0},
    )  # fmt: skip


def deviations(axis: Axes, found: dict[str, dict[int, Way]]) -> None:
    """Draw the deviation in descent of each policy, under those that the paper gives."""
    bars = [(f"paper: {name}", value, "", "0.7") for name, value in PAPER.items()]
    for row, (label, ways) in enumerate(found.items()):
        x = ways[cross_section.DOWN].position
        value = 100 * deviation(x) if len(x) else 0.0
        bars.append((label, value, f", n = {len(x)}" if len(x) else NONE, f"C{row}"))
    for y, (_, value, note, colour) in enumerate(bars):
        axis.barh(y, value, color=colour)
        said = note if note == NONE else f"{value:.1f}{note}"
        axis.text(value + 0.15, y, said, va="center", size=8)
    axis.set_yticks(range(len(bars)), [label for label, *_ in bars])
    axis.set(xlabel="MAD in descent, cm", xlim=(0, 1.4 * max(value for _, value, *_ in bars)))
    axis.invert_yaxis()


if __name__ == "__main__":
    main()
