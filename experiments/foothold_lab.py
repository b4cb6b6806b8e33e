"""Foot placement on stairs (Sec. III-B): `python experiments/foothold_lab.py`.

    python experiments/foothold_lab.py --policies ours=policies/stairs fcqr=runs/F nofr=runs/N

draws one row per policy; `--policy` or `--run` names a single one. Writes footholds_on_stairs.png
and footholds_on_stairs.csv (one row per touchdown). 64 robots take one to two minutes per policy on
4 busy cores, 25 s of which are compilation.

Half the robots walk a flight up, half a flight down: hard stairs, 20 cm rise, 30 cm tread
(terrains/flight.toml).
A touchdown is a contact of either foot with a tread, after at least 0.06 s in the air, of a robot
that has not failed; cref_jax/evaluation/touchdowns.py has its numbers. Its position is that of the
sole's centre, from the tread's nosing (0) towards its riser (30 cm), in ascent and in descent. MAD
is the median absolute deviation from the median. d_xz is the distance used by the foothold reward:
that to the nearest candidate frozen at liftoff, in the x-z plane; undefined if no window was
accepted.

A riser collision begins when a contact sphere touches a riser that faces the robot, or its nosing:
the nearest surface is closer than the sphere's radius, and its normal points back along the lane
within 45 degrees. That happens in ascent only. Spheres of the foot (the ankle-roll link) and those
on the front of the shank, from 9 cm above the ankle up, are counted separately; the ankle itself
has none. Collisions are checked once per control step, at 50 Hz.

The paper, in descent: 1.4 cm, 2.8 cm with FCQR, 9.8 cm without a foothold reward; and no
ankle-riser collisions in ascent. A policy that has not learnt stairs gives empty panels and an
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
from cref_jax.evaluation import protocol, recorder, touchdowns
from cref_jax.evaluation.recorder import Moment, StepRecords
from cref_jax.policy import sources
from cref_jax.robot import kinematics
from cref_jax.system import jax_setup
from cref_jax.terrain import cross_section, lanes

KINDS = ("ascent", "descent")  # lanes of one flight each
TREAD = 0.30  # m, terrains/flight.toml
FACING = -0.7  # largest x of a riser's normal: within 45 degrees of -x
PAPER = {"ours": 1.4, "FCQR": 2.8, "NoFR": 9.8}  # cm, MAD in descent, Sec. III-B
NONE = "no touchdown"
WAYS = {cross_section.UP: "ascent", cross_section.DOWN: "descent"}
COLUMNS = ("policy", "way", "robot", "foot", "time_s", "position_cm", "d_xz_cm")


@dataclass(frozen=True)
class Options(recorder.Options):
    """Compare the foot placement of policies on stairs."""

    policies: Annotated[tuple[str, ...], tyro.conf.arg(metavar="LABEL=PATH ...")] = ()
    """exported policies (directories or .zip) or runs, one row of the image each"""
    policy: Path | None = None
    """a single exported policy"""
    run: Path | None = None
    """a single run (default: the newest run, or the bundled policy without runs)"""
    rise: float = 0.20
    """rise of a step, m"""
    seconds: float = 40.0
    """length of a trial, s"""
    out: Path = Path("footholds_on_stairs.png")
    """image to write; the table is written beside it as .csv"""


class Step(NamedTuple):
    """Data recorded after each control step of E robots."""

    base_x: Float[Array, " E"]  # m
    sole: Float[Array, "E F 3"]  # m, centre of the sole
    touchdown: Bool[Array, "E F"]
    air_time: Float[Array, "E F"]  # s in the air before this step
    distance: Float[Array, "E F"]  # m, d_xz; inf without a candidate
    foot_riser: Bool[Array, "E F"]  # contact of the foot with a riser facing the robot
    shank_riser: Bool[Array, "E F"]


class FlightStats(NamedTuple):
    """Touchdowns and riser collisions on the flights of one direction."""

    robots: int  # on the lanes
    reached: int  # robots that reached the flight
    crossed: int  # robots that reached its end
    robot: np.ndarray  # number of the robot, per touchdown
    foot: np.ndarray  # 0 left, 1 right
    time: np.ndarray  # s
    position: np.ndarray  # m
    distance: np.ndarray  # m, d_xz; inf without a candidate
    foot_riser: int  # collisions
    shank_riser: int
    collided: int  # robots with a collision

    def format_touchdowns(self) -> str:
        """Format arrivals and touchdowns as one line of text."""
        text = f"{self.format_arrivals()}, {len(self.position)} touchdowns"
        if not len(self.position):
            return text
        nearest = 100 * np.median(self.distance)
        return (
            f"{text}, median {100 * np.median(self.position):.1f} cm, "
            f"MAD {100 * touchdowns.median_absolute_deviation(self.position):.1f} cm, median d_xz "
            + (f"{nearest:.1f} cm" if np.isfinite(nearest) else "undefined: half had no candidate")
        )

    def format_arrivals(self) -> str:
        """Format the numbers of robots that reached the flight and its end."""
        return f"{self.reached} of {self.robots} robots reached it, {self.crossed} reached its end"

    def format_collisions(self) -> str:
        """Format the numbers of riser collisions."""
        return (
            f"{self.collided} robots touched a riser: {self.foot_riser} times with a foot, "
            f"{self.shank_riser} with a shank"
        )


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a user error prints one line and exits with code 2."""
    with cli.one_line_errors(arguments):
        options = tyro.cli(Options, args=arguments)
        jax_setup.prepare()
        out = cli.prepare_output(options.out, ".png")
        results = {
            label: measure_policy(path, options) for label, path in resolve_labels(options).items()
        }
        for label, stats in results.items():
            for way, name in WAYS.items():
                print(f"{label}, {name}: {stats[way].format_touchdowns()}")
            print(f"{label}, ascent: {stats[cross_section.UP].format_collisions()}")
            if not any(len(stats[way].position) for way in WAYS):
                print(f"{label}: no touchdown on these stairs, nothing to draw")
        recorder.write_csv(out.with_suffix(".csv"), COLUMNS, make_rows(results))
        draw(out, results, options)
        print(f"wrote {out} and {out.with_suffix('.csv')}")


def resolve_labels(options: Options) -> dict[str, Path]:
    """Map each label to its policy or run.

    Raises:
        ConfigError: a label is missing or repeated, or --policies is combined with other options.
    """
    if not options.policies:
        source = sources.resolve_policy(options.run, options.policy)
        return {source.stem: source}
    if options.run or options.policy:
        raise ConfigError("give --policies, or one --policy or --run")
    pairs = [text.partition("=") for text in options.policies]
    labels = [label for label, _, _ in pairs]
    if not all(label and path for label, _, path in pairs) or len(set(labels)) < len(labels):
        raise ConfigError(
            f"--policies must be different LABEL=PATH, not {' '.join(options.policies)}"
        )
    return {label: sources.find_policy(Path(path)) for label, _, path in pairs}


def measure_policy(path: Path, options: Options) -> dict[int, FlightStats]:
    """Run one policy on the flights and summarise each direction."""
    policy, world = recorder.open_policy(None, path, options.engine)
    sizes = {kind: (options.rise,) for kind in KINDS}
    stairs = lanes.build_grid(policy.config.terrain, sizes, protocol.LANE_SEEDS)
    world = recorder.make_trial_world(policy.config, world, stairs, options.command)
    robots = recorder.start_robots(
        world, options.seed, recorder.default_num_envs(options.num_envs, 2048)
    )
    steps = recorder.count_steps(options.seconds, policy.config)
    watched = recorder.record(world, policy.train, robots, steps, record_step)
    return summarize(world, watched)


def record_step(world: World, moment: Moment) -> Step:
    """Record the positions of the feet and the contacts with risers."""
    state = moment.after.env
    soles, hits = jax.vmap(lambda s: _feet_and_riser_hits(world, s))(state)
    spheres = world.physics.robot.spheres
    left = np.array([name.startswith("left") for name in spheres.names])
    per_foot = lambda which: jnp.stack(
        [hits[:, which & side].any(axis=1) for side in (left, ~left)], axis=1
    )
    return Step(
        base_x=state.body.qpos[:, 0],
        sole=soles,
        touchdown=moment.outcome.measures.touchdown,
        air_time=moment.robots.env.gait.air_time,
        distance=moment.outcome.measures.foothold_distance,
        foot_riser=per_foot(spheres.foot >= 0),
        shank_riser=per_foot(spheres.foot < 0),
    )


def _feet_and_riser_hits(world: World, state) -> tuple[Float[Array, "F 3"], Bool[Array, " S"]]:
    """Compute the sole centres of one robot, m, and which spheres touch a riser."""
    robot, links = world.physics.robot, world.physics.links(state.body)
    ground = world.lanes.tile(state.level, state.kind)
    centres = kinematics.points(links, robot.spheres.body, robot.spheres.position)
    _, normal, distance = jax.vmap(lambda p: terrain.closest_point(ground, p))(centres)
    hits = (distance < robot.spheres.radius) & (normal[:, 0] < FACING)
    return footholds.soles(links, robot).centre, hits


def summarize(world: World, watched: StepRecords) -> dict[int, FlightStats]:
    """Summarise touchdowns and riser collisions for each direction."""
    alive, seen = watched.alive, watched.seen
    period = world.config.physics.control_period
    t, robot, foot = np.nonzero(
        seen.touchdown & alive[..., None] & (seen.air_time >= touchdowns.AIR)
    )
    sole = seen.sole[t, robot, foot]
    flight, position = np.zeros(len(t), int), np.zeros(len(t))
    lane, levels = recorder.round_robin_lanes(world.lanes, alive.shape[1])
    onto, over = np.zeros_like(alive), np.zeros_like(alive)
    for e, (kind, level) in enumerate(zip(lane, levels, strict=True)):
        stairs, own = cross_section.from_lane(world.lanes.tile(level, kind)), robot == e
        place = touchdowns.place(stairs, sole[own, 0], sole[own, 2])
        flight[own], position[own] = place.flight, place.position
        treads, x = np.flatnonzero(stairs.flight), seen.base_x[:, e]
        onto[:, e] = alive[:, e] & (x > stairs.left[treads[0]])
        over[:, e] = alive[:, e] & (x > stairs.right[treads[-1]])
    foot_hits, shank_hits = (
        recorder.find_onsets(flag & alive[..., None])
        for flag in (seen.foot_riser, seen.shank_riser)
    )
    stats = {}
    for kind, way in enumerate(WAYS):
        landed, on_lane = flight == way, lane == kind
        stats[way] = FlightStats(
            robots=int(on_lane.sum()),
            reached=int(onto[:, on_lane].any(axis=0).sum()),
            crossed=int(over[:, on_lane].any(axis=0).sum()),
            robot=robot[landed],
            foot=foot[landed],
            time=(t[landed] + 1) * period,
            position=position[landed],
            distance=seen.distance[t[landed], robot[landed], foot[landed]],
            foot_riser=int(foot_hits[:, on_lane].sum()),
            shank_riser=int(shank_hits[:, on_lane].sum()),
            collided=int((foot_hits | shank_hits)[:, on_lane].any(axis=(0, 2)).sum()),
        )
    return stats


def make_rows(results: dict[str, dict[int, FlightStats]]) -> Iterator[tuple]:
    """Yield a row of the table for each touchdown."""
    for label, stats in results.items():
        for way, name in WAYS.items():
            w = stats[way]
            columns = (w.robot, w.foot, w.time, w.position, w.distance)
            for n, foot, time, position, d in zip(*columns, strict=True):
                d_xz = 100 * d if np.isfinite(d) else ""
                yield label, name, n, ("left", "right")[foot], time, 100 * position, d_xz


def draw(out: Path, results: dict[str, dict[int, FlightStats]], options: Options) -> None:
    """Draw one row of histograms per policy, and the deviations beside the paper's."""
    size = (11, 1.2 + 2.4 * len(results))
    figure = plt.figure(figsize=size, constrained_layout=True)
    grid = figure.add_gridspec(len(results), 3, width_ratios=(3, 3, 2))
    for row, (label, stats) in enumerate(results.items()):
        for column, (way, name) in enumerate(WAYS.items()):
            axis = figure.add_subplot(grid[row, column])
            draw_histogram(axis, stats[way], f"C{row}")
            axis.set_title(f"{label}, {name}", fontsize=10)
            if row == len(results) - 1:
                axis.set_xlabel("from nosing (0) towards riser, cm")
    draw_deviations(figure.add_subplot(grid[:, 2]), results)
    figure.suptitle(
        f"Position of the sole's centre at touchdown, both feet: rise {100 * options.rise:g} cm, "
        f"tread {100 * TREAD:g} cm, {options.command:g} m/s",
        fontsize=11,
    )
    figure.savefig(out, dpi=90)


def draw_histogram(axis: Axes, stats: FlightStats, colour: str) -> None:
    """Draw the distribution of touchdowns between nosing and riser."""
    edges = 100 * touchdowns.bin_edges(TREAD)
    for x in (0.0, 100 * TREAD):
        axis.axvline(x, color="0.5", lw=0.8, ls="--")
    axis.set(xlim=(edges[0], edges[-1]), ylabel="share of touchdowns")
    notes = [stats.format_arrivals()]
    if len(stats.position):
        weights = np.full(len(stats.position), 1.0 / len(stats.position))
        axis.hist(100 * stats.position, edges, weights=weights, color=colour, alpha=0.8)
        notes += [
            f"{len(stats.position)} touchdowns",
            f"MAD {100 * touchdowns.median_absolute_deviation(stats.position):.1f} cm",
        ]
    else:
        axis.set(yticks=[], ylim=(0, 1))
        notes += [NONE]
    if stats.collided:
        notes += stats.format_collisions().split(": ")
    axis.set_ylim(top=1.7 * axis.get_ylim()[1] if len(stats.position) else 1.0)
    axis.text(
        0.98, 0.96, "\n".join(notes), transform=axis.transAxes, ha="right", va="top", size=8,
        bbox={"color": "w", "alpha": 0.8, "pad": 1.0},
    )  # fmt: skip


def draw_deviations(axis: Axes, results: dict[str, dict[int, FlightStats]]) -> None:
    """Draw the deviation in descent of each policy below those of the paper."""
    bars = [(f"paper: {name}", value, "", "0.7") for name, value in PAPER.items()]
    for row, (label, stats) in enumerate(results.items()):
        x = stats[cross_section.DOWN].position
        value = 100 * touchdowns.median_absolute_deviation(x) if len(x) else 0.0
        bars.append((label, value, f", n = {len(x)}" if len(x) else NONE, f"C{row}"))
    for y, (_, value, note, colour) in enumerate(bars):
        axis.barh(y, value, color=colour)
        text = note if note == NONE else f"{value:.1f}{note}"
        axis.text(value + 0.15, y, text, va="center", size=8)
    axis.set_yticks(range(len(bars)), [label for label, *_ in bars])
    axis.set(xlabel="MAD in descent, cm", xlim=(0, 1.4 * max(value for _, value, *_ in bars)))
    axis.invert_yaxis()


if __name__ == "__main__":
    main()
