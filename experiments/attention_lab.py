"""What the query looks at: `python experiments/attention_lab.py`.

Writes attention.png and attention.csv: the weights that the cross attention of Eq. 10 gives the
depth tokens, over the depth image while one robot comes to an edge, steps over it and goes on;
their mean on each terrain; and how much of them lies where there is something to see. 140 robots
take two and a half minutes on 4 busy cores, 40 s of which are compilation.

A token stands for the block of pixels that lies under it (8 x 8). It has a ground edge where a
pixel of it lies more than 3 cm off the plane through its two neighbours in its row or column, links
of the robot apart: a jump or a crease of the ground. It has own links where a leg or an arm is in
view.

Enrichment is the share of the attention, mean of the heads, on such tokens over their share of all
tokens: 1 if the query looks anywhere, N / n if it looks at these n of N tokens alone. Beside it
stands what the policy's mean map of that terrain would have, which never moves: only what is above
it shows that the query follows the scene. Frames without such a token, or with nothing else, do not
count. A terrain begins 1.5 m before its first obstacle. A row of tokens has the distance at which
it meets level ground, from the pelvis of the standing robot. Frames come 20 times a second and are
far from independent.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro
from jaxtyping import Array, Bool, Float, Float16, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from cref_jax import cli
from cref_jax.config import Config
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.evaluation import attention, recorder
from cref_jax.evaluation.recorder import Moment, Watched
from cref_jax.system import jax_setup
from cref_jax.terrain import cross_section

EDGE = (
    0.03  # m off the plane of the neighbours; assumed: above rounding and the slope's 2 cm columns
)
AHEAD = 1.5  # m before an obstacle from where it counts as such; most of what the camera sees
MOMENTS = (-0.9, -0.5, -0.2, 0.1, 0.5)  # m from the edge to the pelvis
FOLLOWED = 8  # robots whose images are kept, to choose one of
TERRAINS = ("flat", "stairs up", "stairs down", "gap", "platform", "rough", "slope")
TARGETS = ("ground edge", "own links")
COLUMNS = (
    "terrain", "where", "frames", "token_share", "attention_share", "enrichment",
    "enrichment_of_mean_map",
)  # fmt: skip


@dataclass(frozen=True)
class Options(recorder.Options):
    """Draw what the attention of a policy looks at, and count it."""

    run: Path | None = None
    """runs/NAME; the newest one when left out, or the bundled policy where there is none"""
    policy: Path | None = None
    """an exported policy (a directory or .zip) instead of a run"""
    kind: str | None = None
    """of the lane that one robot is followed on; when left out, of the policy's own terrain"""
    seconds: float = 20.0
    """length of a trial"""
    out: Path = Path("attention.png")
    """the picture to write; the table stands beside it"""


class Step(NamedTuple):
    """What is kept of a control step of E robots.

    A frame that is exposed in this step is attended to in the next.
    """

    exposed: Bool[Array, " E"]  # a frame is
    base_x: Float[Array, " E"]  # m, when it is
    edge: Bool[Array, "E N"]  # tokens of that frame
    own: Bool[Array, "E N"]
    frame: Float16[Array, "R H W"]  # D, of the R robots that are followed
    attention: Float[Array, "E heads N"]  # to the frame before


class Frames(NamedTuple):
    """F frames of all robots, and the attention that each got when it came."""

    step: Int[np.ndarray, " F"]
    robot: Int[np.ndarray, " F"]
    attention: Float[np.ndarray, "F heads N"]
    targets: dict[str, Bool[np.ndarray, "F N"]]


class Row(NamedTuple):
    """Where the attention lies on one terrain."""

    terrain: str
    where: str
    frames: int
    token_share: float
    attention_share: float
    enrichment: float
    enrichment_of_mean_map: float


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a mistake in it is one line and exit code 2."""
    options = tyro.cli(Options, args=arguments)
    with cli.one_line_errors(options.debug):
        jax_setup.prepare()
        out = cli.writable(options.out, ".png")
        policy, world = recorder.open_policy(options.run, options.policy, options.engine)
        c = policy.config
        check(c)
        kind = recorder.kind_of_lane(c, options.kind)
        world = recorder.place_robots(c, world, recorder.medium_lanes(c), options.command)
        count = recorder.default_num_envs(options.num_envs, on_accelerator=512)
        robots = recorder.begin(world, options.seed, count)
        kinds, _ = recorder.round_robin_lanes(world.lanes, count)
        followed = np.flatnonzero(kinds == world.lanes.kinds.index(kind))[:FOLLOWED]
        if not followed.size:
            raise ConfigError(f"--num-envs must be at least {len(world.lanes.kinds)}: one a lane")
        steps = recorder.steps_of(options.seconds, c)
        seeing = functools.partial(look, tuple(followed))
        watched = recorder.watch(world, policy.train, robots, steps, seeing)
        frames = attended(watched)
        terrain = recorder.terrain_under(world.lanes, watched.seen.base_x, AHEAD)
        of_frame = terrain[frames.step, frames.robot]
        found = list(rows(frames, of_frame, attention.ahead(world), attention.grid(c)))
        recorder.write_table(out.with_suffix(".csv"), COLUMNS, found)
        for row in found:
            if row.where in TARGETS:
                print(line(row))
        figure = plt.figure(figsize=(13.5, 7.0), constrained_layout=True)
        left, right = figure.subfigures(1, 2, width_ratios=(1.15, 1.0))
        strip(left, world, watched, frames, followed, kind)
        maps_and_bars(right, frames, of_frame, found, world)
        figure.savefig(out, dpi=85)
        print(f"wrote {out} and {out.with_suffix('.csv')}")


def check(c: Config) -> None:
    """Refuse a policy without attention.

    Raises:
        ConfigError: it has none.
    """
    if c.network.variant in ("blind", "no_cross_attention"):
        raise ConfigError(
            f"this policy has no attention: its variant is '{c.network.variant}'; take any other"
        )


def look(followed: tuple[int, ...], world: World, moment: Moment) -> Step:
    """Return the frame that is exposed, what is in it, and the attention to the one before."""
    state, feed = moment.robots.env, moment.after.feed
    images = feed.images(world.config.network)
    shape = attention.grid(world.config)

    def targets() -> tuple[Bool[Array, "E N"], Bool[Array, "E N"]]:
        camera = world.config.camera
        metres = (images.astype(jnp.float32) + 0.5) * camera.d_max
        ground = jax.vmap(lambda s: attention.ground_alone(world, s))(state)
        own = metres < ground - attention.LINK
        edge = attention.is_edge(ground, camera) & ~own
        return attention.in_tokens(edge, shape), attention.in_tokens(own, shape)

    none = jnp.zeros((state.step.size, shape[0] * shape[1]), bool)
    edge, own = jax.lax.cond(feed.fresh, targets, lambda: (none, none))
    return Step(
        exposed=jnp.broadcast_to(feed.fresh, state.step.shape),
        base_x=state.body.qpos[:, 0],
        edge=edge,
        own=own,
        frame=images[np.array(followed)],
        attention=moment.policy.attention[0],
    )


def attended(watched: Watched) -> Frames:
    """Return the frames of robots that lived on, with the attention of the step after."""
    seen = watched.seen
    t, robot = np.nonzero(seen.exposed[:-1] & watched.alive[1:])
    targets = dict(zip(TARGETS, (seen.edge[t, robot], seen.own[t, robot]), strict=True))
    return Frames(t, robot, seen.attention[t + 1, robot], targets)


def rows(
    frames: Frames,
    terrain: np.ndarray,
    distances: Float[np.ndarray, " rows"],
    shape: tuple[int, int],
) -> Iterator[Row]:
    """Yield where the attention lies on each terrain: on edges, on links, and by row."""
    mean = frames.attention.mean(axis=1)
    for name in TERRAINS:
        there = terrain == name
        if not there.any():
            continue
        fixed = mean[there].mean(axis=0)
        for where, tokens in frames.targets.items():
            counts = tokens[there].any(axis=1) & ~tokens[there].all(axis=1)
            n, chosen = int(counts.sum()), tokens[there][counts]
            if n:
                share, got = attention.shares(mean[there][counts], chosen)
                _, still = attention.shares(np.broadcast_to(fixed, chosen.shape), chosen)
                yield Row(name, where, n, share, got, got / share, still / share)
        by_row = fixed.reshape(shape).sum(axis=1)
        for k, got in enumerate(by_row):
            where, n = f"row {k}, {distances[k]:.2f} m ahead", int(there.sum())
            rich = float(got) * shape[0]
            yield Row(name, where, n, 1.0 / shape[0], float(got), rich, rich)


def line(row: Row) -> str:
    """Return one row in one line for people."""
    return (
        f"{row.terrain:12} {row.where:11} {row.frames:6d} frames: {row.attention_share:.0%} of the "
        f"attention on {row.token_share:.0%} of the tokens, {row.enrichment:.2f} times "
        f"(the mean map: {row.enrichment_of_mean_map:.2f})"
    )


def strip(
    figure: SubFigure,
    world: World,
    watched: Watched,
    frames: Frames,
    followed: Int[np.ndarray, " n"],
    kind: str,
) -> None:
    """Draw depth and attention of the followed robot that came furthest, at each of MOMENTS."""
    c, seen, k = world.config, watched.seen, world.lanes.kinds.index(kind)
    grid = attention.grid(c)
    far = np.where(watched.alive, seen.base_x, -np.inf)[:, followed].max(axis=0)
    place = int(np.argmax(far))
    mine = np.flatnonzero(frames.robot == followed[place])
    _, levels = recorder.round_robin_lanes(world.lanes, watched.alive.shape[1])
    steps = cross_section.edges(cross_section.of_lane(world.lanes.tile(levels[followed[place]], k)))
    edge = float(steps[0]) if steps.size else 2.0
    heads = frames.attention.shape[1]
    axes = figure.subplots(2 + heads, len(MOMENTS), squeeze=False)
    lane = recorder.name_of_lane(world, kind)
    figure.suptitle(
        f"one robot on {lane}; x: from the lane's first edge to its pelvis\n"
        "orange: attention, each map up to its own largest; blue dots: tokens with a ground edge",
        fontsize=9,
    )
    if not mine.size:
        return
    x = seen.base_x[frames.step[mine], followed[place]]
    for column, moment in enumerate(MOMENTS):
        at = mine[int(np.argmin(np.abs(x - edge - moment)))]
        image = seen.frame[frames.step[at], place].astype(np.float32)
        there = seen.base_x[frames.step[at], followed[place]] - edge
        axes[0, column].imshow(image, cmap="viridis_r", vmin=-0.5, vmax=0.5)
        axes[0, column].set_title(f"x = {there:+.2f} m", fontsize=9)
        weights = frames.attention[at]
        for row, given in enumerate([weights.mean(axis=0), *weights], start=1):
            edges = frames.targets["ground edge"][at].reshape(grid)
            overlay(axes[row, column], image, attention.upsampled(given, grid, image.shape), edges)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    names = [
        f"depth,\n0-{c.camera.d_max:g} m",
        "mean of\nheads",
        *(f"head {h}" for h in range(heads)),
    ]
    for axis, name in zip(axes[:, 0], names, strict=True):
        axis.set_ylabel(name, fontsize=8)


def overlay(
    axis: Axes,
    image: Float[np.ndarray, "H W"],
    weights: Float[np.ndarray, "H W"],
    edges: Bool[np.ndarray, "rows columns"],
) -> None:
    """Draw attention over the depth image, and a dot in the tokens with an edge."""
    axis.imshow(image, cmap="gray_r", vmin=-0.7, vmax=0.5)
    paint = np.ones((*image.shape, 4)) * matplotlib.colors.to_rgba("darkorange")
    paint[..., 3] = weights / weights.max()
    axis.imshow(paint)
    row, column = np.nonzero(edges)
    high, wide = image.shape[0] / edges.shape[0], image.shape[1] / edges.shape[1]
    axis.plot((column + 0.5) * wide - 0.5, (row + 0.5) * high - 0.5, ".", color="b", ms=2.5)


def maps_and_bars(
    figure: SubFigure, frames: Frames, terrain: np.ndarray, found: list[Row], world: World
) -> None:
    """Draw the mean attention on each terrain, and how much of it is on edges and links."""
    above, below = figure.subfigures(2, 1, height_ratios=(1.0, 1.0))
    shape, distances = attention.grid(world.config), attention.ahead(world)
    mean = frames.attention.mean(axis=1)
    axes = above.subplots(2, 4)
    above.suptitle("mean attention by terrain", fontsize=10)
    image = None
    for axis, name in zip(axes.flat, TERRAINS, strict=False):
        there = terrain == name
        axis.set_title(f"{name}\n{there.sum():,} frames", fontsize=8)
        axis.set(xticks=[], yticks=[])
        if there.any():
            share = mean[there].mean(axis=0).reshape(shape) * mean.shape[1]
            image = axis.imshow(share, cmap="magma", vmin=0.0, vmax=3.0)
    for axis in axes[:, 0]:
        axis.set_yticks(range(shape[0]), [f"{x:.1f}" for x in distances], fontsize=7)
        axis.set_ylabel("row meets level\nground, m ahead", fontsize=7)
    axes.flat[-1].set_axis_off()
    if image is not None:
        bar = above.colorbar(image, ax=axes, extend="max", fraction=0.03)
        bar.set_label("times an even share", fontsize=8)
    bars(below, found)


def bars(figure: Figure | SubFigure, found: list[Row]) -> None:
    """Draw the enrichment on each terrain, and that of a map that never moves."""
    axis = figure.subplots()
    for k, where in enumerate(TARGETS):
        mine = [row for row in found if row.where == where]
        x = np.array([TERRAINS.index(row.terrain) for row in mine]) + 0.4 * k - 0.2
        axis.bar(x, [row.enrichment for row in mine], 0.38, color=f"C{k}", label=where)
        for at, row in zip(x, mine, strict=True):
            axis.plot([at - 0.19, at + 0.19], [row.enrichment_of_mean_map] * 2, color="k", lw=1.5)
            axis.text(at, row.enrichment, f"{row.frames:,}", ha="center", va="bottom", size=6)
    axis.axhline(1.0, color="0.5", lw=0.8, ls="--")
    axis.plot([], [], color="k", lw=1.5, label="the same of the mean map")
    axis.set_xticks(range(len(TERRAINS)), TERRAINS, fontsize=8)
    axis.set_xlim(-0.6, len(TERRAINS) - 0.4)
    axis.set_ylabel("share of attention\nover share of tokens", fontsize=8)
    axis.set_ylim(top=1.25 * axis.get_ylim()[1])
    axis.legend(fontsize=7, loc="upper right", ncols=3)
    axis.set_title("enrichment (1: looks anywhere); small numbers: frames", fontsize=9)


if __name__ == "__main__":
    main()
