"""Where the cross attention looks: `python experiments/attention_lab.py`.

Writes attention.png and attention.csv: the weights that the cross attention of Eq. 10 gives the
depth tokens, over the depth image while one robot approaches an edge, crosses it and walks on;
their mean on each terrain; and their share on edges and on the robot's own links. 140 robots take
two and a half minutes on 4 busy cores, 40 s of which are compilation.

A token covers a block of 8 x 8 pixels. It has a ground edge if one of its pixels lies more than
3 cm off the plane through its two neighbours in its row or column, a jump or a crease of the
ground; pixels on the robot's links do not count. It has own links if a leg or an arm is in view.

Enrichment is the share of the attention (mean over heads) on such tokens over their share of all
tokens: 1 if the attention is uniform, N / n if it is only on these n of N tokens. It is compared
with the enrichment of the policy's mean map of the terrain, which never moves: only the excess over
it shows that the attention follows the scene. Frames in which no token or every token is such are
excluded. A terrain begins 1.5 m before its first obstacle. The distance of a row of tokens is from
the pelvis of the standing robot to where the row meets level ground. Frames come at 20 Hz and are
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
from cref_jax.env import environment
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.evaluation import attention, recorder
from cref_jax.evaluation.recorder import Moment, StepRecords
from cref_jax.system import jax_setup
from cref_jax.terrain import cross_section

AHEAD = 1.5  # m before an obstacle where its terrain begins; most of the camera's range
MOMENTS = (-0.9, -0.5, -0.2, 0.1, 0.5)  # m from the edge to the pelvis
FOLLOWED = 8  # robots whose images are kept, one of which is drawn
TERRAINS = ("flat", "stairs up", "stairs down", "gap", "platform", "rough", "slope")
TARGETS = ("ground edge", "own links")
COLUMNS = (
    "terrain", "where", "frames", "token_share", "attention_share", "enrichment",
    "enrichment_of_mean_map",
)  # fmt: skip


@dataclass(frozen=True)
class Options(recorder.Options):
    """Draw and measure where the attention of a policy looks."""

    run: Path | None = None
    """runs/NAME (default: the newest run, or the bundled policy without runs)"""
    policy: Path | None = None
    """exported policy (a directory or .zip) instead of a run"""
    kind: str | None = None
    """kind of lane on which one robot is followed (default: one of the policy's own terrain)"""
    seconds: float = 20.0
    """length of a trial, s"""
    out: Path = Path("attention.png")
    """image to write; the table is written beside it as .csv"""


class Step(NamedTuple):
    """Data recorded per control step of E robots.

    A frame exposed in this step is attended to in the next.
    """

    exposed: Bool[Array, " E"]  # whether a frame is exposed
    base_x: Float[Array, " E"]  # m, at exposure
    edge: Bool[Array, "E N"]  # tokens of that frame with a ground edge
    own: Bool[Array, "E N"]  # tokens with own links
    frame: Float16[Array, "R H W"]  # D, of the R followed robots
    attention: Float[Array, "E heads N"]  # on the previous frame


class Frames(NamedTuple):
    """F frames of all robots, and the attention on each when it arrived."""

    step: Int[np.ndarray, " F"]
    robot: Int[np.ndarray, " F"]
    attention: Float[np.ndarray, "F heads N"]
    targets: dict[str, Bool[np.ndarray, "F N"]]


class Row(NamedTuple):
    """Attention on one set of tokens on one terrain."""

    terrain: str
    where: str
    frames: int
    token_share: float
    attention_share: float
    enrichment: float
    enrichment_of_mean_map: float


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a user error prints one line and exits with code 2."""
    with cli.one_line_errors(arguments):
        options = tyro.cli(Options, args=arguments)
        jax_setup.prepare()
        out = cli.prepare_output(options.out, ".png")
        policy, world = recorder.open_policy(options.run, options.policy, options.engine)
        c = policy.config
        check_variant(c)
        kind = recorder.choose_kind(c, options.kind)
        world = recorder.make_trial_world(c, world, recorder.medium_lanes(c), options.command)
        count = recorder.default_num_envs(options.num_envs, on_accelerator=512)
        robots = recorder.start_robots(world, options.seed, count)
        kinds, _ = recorder.round_robin_lanes(world.lanes, count)
        followed = np.flatnonzero(kinds == world.lanes.kinds.index(kind))[:FOLLOWED]
        if not followed.size:
            raise ConfigError(f"--num-envs must be at least {len(world.lanes.kinds)}, one per lane")
        steps = recorder.count_steps(options.seconds, c)
        record = functools.partial(record_step, tuple(followed))
        watched = recorder.record(world, policy.train, robots, steps, record)
        frames = select_frames(watched)
        terrain = recorder.terrain_under(world.lanes, watched.seen.base_x, AHEAD)
        of_frame = terrain[frames.step, frames.robot]
        rows = list(
            make_rows(frames, of_frame, attention.ground_distances(world), attention.token_grid(c))
        )
        recorder.write_csv(out.with_suffix(".csv"), COLUMNS, rows)
        for row in rows:
            if row.where in TARGETS:
                print(format_row(row))
        figure = plt.figure(figsize=(13.5, 7.0), constrained_layout=True)
        left, right = figure.subfigures(1, 2, width_ratios=(1.15, 1.0))
        draw_strip(left, world, watched, frames, followed, kind)
        draw_maps_and_bars(right, frames, of_frame, rows, world)
        figure.savefig(out, dpi=85)
        print(f"wrote {out} and {out.with_suffix('.csv')}")


def check_variant(c: Config) -> None:
    """Check that the policy has attention.

    Raises:
        ConfigError: it has none.
    """
    if c.network.variant in ("blind", "no_cross_attention"):
        raise ConfigError(
            f"this policy has no attention: its variant is '{c.network.variant}'; use another"
        )


def record_step(followed: tuple[int, ...], world: World, moment: Moment) -> Step:
    """Record the exposed frame, its edges and links, and the attention on the previous frame."""
    state, feed = moment.robots.env, moment.after.feed
    images = feed.images(world.config.network)
    shape = attention.token_grid(world.config)

    def targets() -> tuple[Bool[Array, "E N"], Bool[Array, "E N"]]:
        camera = world.config.camera
        metres = (images.astype(jnp.float32) + 0.5) * camera.d_max
        ground = jax.vmap(lambda s: environment.render_depth(world, s, with_links=False))(state)
        own = metres < ground - attention.LINK
        edge = attention.is_edge(ground, camera) & ~own
        return attention.pool_to_tokens(edge, shape), attention.pool_to_tokens(own, shape)

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


def select_frames(watched: StepRecords) -> Frames:
    """Select the frames of surviving robots, with the attention of the next step."""
    seen = watched.seen
    t, robot = np.nonzero(seen.exposed[:-1] & watched.alive[1:])
    targets = dict(zip(TARGETS, (seen.edge[t, robot], seen.own[t, robot]), strict=True))
    return Frames(t, robot, seen.attention[t + 1, robot], targets)


def make_rows(
    frames: Frames,
    terrain: np.ndarray,
    distances: Float[np.ndarray, " rows"],
    shape: tuple[int, int],
) -> Iterator[Row]:
    """Yield the attention on each terrain: on edges, on links, and by row of tokens."""
    mean = frames.attention.mean(axis=1)
    for name in TERRAINS:
        on_terrain = terrain == name
        if not on_terrain.any():
            continue
        mean_map = mean[on_terrain].mean(axis=0)
        for where, tokens in frames.targets.items():
            counts = tokens[on_terrain].any(axis=1) & ~tokens[on_terrain].all(axis=1)
            n, targets = int(counts.sum()), tokens[on_terrain][counts]
            if n:
                share, weight = attention.compute_shares(mean[on_terrain][counts], targets)
                _, static = attention.compute_shares(
                    np.broadcast_to(mean_map, targets.shape), targets
                )
                yield Row(name, where, n, share, weight, weight / share, static / share)
        by_row = mean_map.reshape(shape).sum(axis=1)
        for k, weight in enumerate(by_row):
            where, n = f"row {k}, {distances[k]:.2f} m ahead", int(on_terrain.sum())
            enrichment = float(weight) * shape[0]
            yield Row(name, where, n, 1.0 / shape[0], float(weight), enrichment, enrichment)


def format_row(row: Row) -> str:
    """Format a row as one line of text."""
    return (
        f"{row.terrain:12} {row.where:11} {row.frames:6d} frames: {row.attention_share:.0%} of the "
        f"attention on {row.token_share:.0%} of the tokens, enrichment {row.enrichment:.2f} "
        f"(mean map: {row.enrichment_of_mean_map:.2f})"
    )


def draw_strip(
    figure: SubFigure,
    world: World,
    watched: StepRecords,
    frames: Frames,
    followed: Int[np.ndarray, " n"],
    kind: str,
) -> None:
    """Draw depth and attention of the followed robot that walked furthest, at each of MOMENTS."""
    c, seen, k = world.config, watched.seen, world.lanes.kinds.index(kind)
    grid = attention.token_grid(c)
    far = np.where(watched.alive, seen.base_x, -np.inf)[:, followed].max(axis=0)
    place = int(np.argmax(far))
    own = np.flatnonzero(frames.robot == followed[place])
    _, levels = recorder.round_robin_lanes(world.lanes, watched.alive.shape[1])
    steps = cross_section.riser_edges(
        cross_section.from_lane(world.lanes.tile(levels[followed[place]], k))
    )
    edge = float(steps[0]) if steps.size else 2.0
    heads = frames.attention.shape[1]
    axes = figure.subplots(2 + heads, len(MOMENTS), squeeze=False)
    lane = recorder.lane_name(world, kind)
    figure.suptitle(
        f"one robot on {lane}; x: from the first edge of the lane to the pelvis\n"
        "orange: attention, each map scaled to its maximum; blue dots: tokens with a ground edge",
        fontsize=9,
    )
    if not own.size:
        return
    x = seen.base_x[frames.step[own], followed[place]]
    for column, moment in enumerate(MOMENTS):
        at = own[int(np.argmin(np.abs(x - edge - moment)))]
        image = seen.frame[frames.step[at], place].astype(np.float32)
        offset = seen.base_x[frames.step[at], followed[place]] - edge
        axes[0, column].imshow(image, cmap="viridis_r", vmin=-0.5, vmax=0.5)
        axes[0, column].set_title(f"x = {offset:+.2f} m", fontsize=9)
        weights = frames.attention[at]
        for row, head in enumerate([weights.mean(axis=0), *weights], start=1):
            edges = frames.targets["ground edge"][at].reshape(grid)
            draw_overlay(
                axes[row, column], image, attention.upsample(head, grid, image.shape), edges
            )
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    names = [
        f"depth,\n0-{c.camera.d_max:g} m",
        "mean over\nheads",
        *(f"head {h}" for h in range(heads)),
    ]
    for axis, name in zip(axes[:, 0], names, strict=True):
        axis.set_ylabel(name, fontsize=8)


def draw_overlay(
    axis: Axes,
    image: Float[np.ndarray, "H W"],
    weights: Float[np.ndarray, "H W"],
    edges: Bool[np.ndarray, "rows columns"],
) -> None:
    """Draw attention over the depth image, and a dot in each token with an edge."""
    axis.imshow(image, cmap="gray_r", vmin=-0.7, vmax=0.5)
    paint = np.ones((*image.shape, 4)) * matplotlib.colors.to_rgba("darkorange")
    paint[..., 3] = weights / weights.max()
    axis.imshow(paint)
    row, column = np.nonzero(edges)
    high, wide = image.shape[0] / edges.shape[0], image.shape[1] / edges.shape[1]
    axis.plot((column + 0.5) * wide - 0.5, (row + 0.5) * high - 0.5, ".", color="b", ms=2.5)


def draw_maps_and_bars(
    figure: SubFigure, frames: Frames, terrain: np.ndarray, rows: list[Row], world: World
) -> None:
    """Draw the mean attention on each terrain, and its enrichment on edges and links."""
    above, below = figure.subfigures(2, 1, height_ratios=(1.0, 1.0))
    shape, distances = attention.token_grid(world.config), attention.ground_distances(world)
    mean = frames.attention.mean(axis=1)
    axes = above.subplots(2, 4)
    above.suptitle("mean attention by terrain", fontsize=10)
    image = None
    for axis, name in zip(axes.flat, TERRAINS, strict=False):
        on_terrain = terrain == name
        axis.set_title(f"{name}\n{on_terrain.sum():,} frames", fontsize=8)
        axis.set(xticks=[], yticks=[])
        if on_terrain.any():
            share = mean[on_terrain].mean(axis=0).reshape(shape) * mean.shape[1]
            image = axis.imshow(share, cmap="magma", vmin=0.0, vmax=3.0)
    for axis in axes[:, 0]:
        axis.set_yticks(range(shape[0]), [f"{x:.1f}" for x in distances], fontsize=7)
        axis.set_ylabel("row meets level\nground, m ahead", fontsize=7)
    axes.flat[-1].set_axis_off()
    if image is not None:
        bar = above.colorbar(image, ax=axes, extend="max", fraction=0.03)
        bar.set_label("relative to uniform attention", fontsize=8)
    draw_bars(below, rows)


def draw_bars(figure: Figure | SubFigure, rows: list[Row]) -> None:
    """Draw the enrichment on each terrain, and that of the mean map."""
    axis = figure.subplots()
    for k, where in enumerate(TARGETS):
        selected = [row for row in rows if row.where == where]
        x = np.array([TERRAINS.index(row.terrain) for row in selected]) + 0.4 * k - 0.2
        axis.bar(x, [row.enrichment for row in selected], 0.38, color=f"C{k}", label=where)
        for at, row in zip(x, selected, strict=True):
            axis.plot([at - 0.19, at + 0.19], [row.enrichment_of_mean_map] * 2, color="k", lw=1.5)
            axis.text(at, row.enrichment, f"{row.frames:,}", ha="center", va="bottom", size=6)
    axis.axhline(1.0, color="0.5", lw=0.8, ls="--")
    axis.plot([], [], color="k", lw=1.5, label="mean map")
    axis.set_xticks(range(len(TERRAINS)), TERRAINS, fontsize=8)
    axis.set_xlim(-0.6, len(TERRAINS) - 0.4)
    axis.set_ylabel("share of attention\nover share of tokens", fontsize=8)
    axis.set_ylim(top=1.25 * axis.get_ylim()[1])
    axis.legend(fontsize=7, loc="upper right", ncols=3)
    axis.set_title("enrichment (1: uniform); small numbers: frames", fontsize=9)


if __name__ == "__main__":
    main()
