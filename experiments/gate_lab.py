"""When the policy relies on its memory (Sec. III-B): `python experiments/gate_lab.py`.

Writes gate.png and gate.csv: the highway gate beta of Eq. 16, mean over channels, grouped by
terrain, contact phase and posture; and the gate of one robot over time. Near 1 the action relies on
memory, near 0 on the current observation. 140 robots take two minutes on 4 busy cores, 40 s of
which are compilation.

Robots walk lanes of every kind at their medium size (Table II) with one command. Terrain: the lane
of that name, from 0.5 m before its first obstacle to the end of its last; stairs are split by
direction. Phase: flight (no foot in contact), single and double support. Posture: risky (|roll| or
|pitch| above 0.20 rad) or stable. Phase and posture are taken from every step on every lane.
Excluded: the first second, when the memory fills, and all steps after a robot's first episode.

The paper finds higher gates on stairs than on flat ground, in flight than in support, and in risky
than in stable postures. n counts steps of 20 ms over all robots, which are far from independent.
"""

from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes

from cref_jax import cli
from cref_jax.env.world import World
from cref_jax.evaluation import highway_gate, recorder
from cref_jax.evaluation.highway_gate import FEW, GROUPS, Row
from cref_jax.evaluation.recorder import StepRecords
from cref_jax.system import jax_setup
from cref_jax.terrain import Terrain, cross_section

COLUMNS = ("group", "state", "n", "robots", "mean", "q25", "median", "q75", "note")


@dataclass(frozen=True)
class Options(recorder.Options):
    """Group the highway gate of a policy by terrain, contact phase and posture."""

    run: Path | None = None
    """runs/NAME (default: the newest run, or the bundled policy without runs)"""
    policy: Path | None = None
    """exported policy (a directory or .zip) instead of a run"""
    kind: str | None = None
    """kind of lane on which one robot is traced (default: one of the policy's own terrain)"""
    seconds: float = 20.0
    """length of a trial, s"""
    out: Path = Path("gate.png")
    """image to write; the table is written beside it as .csv"""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a user error prints one line and exits with code 2."""
    with cli.one_line_errors(arguments):
        options = tyro.cli(Options, args=arguments)
        jax_setup.prepare()
        out = cli.prepare_output(options.out, ".png")
        policy, world = recorder.open_policy(options.run, options.policy, options.engine)
        c = policy.config
        highway_gate.check_variant(c)
        if c.network.variant == "blind":
            print("blind policy: its gate blends memory with proprioception, without depth")
        kind = recorder.choose_kind(c, options.kind)
        world = recorder.make_trial_world(c, world, recorder.medium_lanes(c), options.command)
        count = recorder.default_num_envs(options.num_envs, on_accelerator=4096)
        robots = recorder.start_robots(world, options.seed, count)
        steps = recorder.count_steps(options.seconds, c)
        watched = recorder.record(world, policy.train, robots, steps, highway_gate.record_step)
        rows = list(highway_gate.make_rows(world, watched))
        recorder.write_csv(
            out.with_suffix(".csv"), COLUMNS, ((*row, row.note) for row in rows if row.n)
        )
        draw(out, rows, world, watched, kind)
        for row in rows:
            print(format_row(row))
        print(f"wrote {out} and {out.with_suffix('.csv')}")


def format_row(row: Row) -> str:
    """Format a row as one line of text."""
    text = f"{row.group:8} {row.state:15} n {row.n:7d} of {row.robots:4d} robots"
    if not row.n:
        return f"{text}: never"
    text += f": mean {row.mean:.3f}, quartiles {row.q25:.3f} {row.median:.3f} {row.q75:.3f}"
    return text + (f" ({row.note})" if row.note else "")


def draw(out: Path, rows: list[Row], world: World, watched: StepRecords, kind: str) -> None:
    """Draw the groups, and one robot's gate, contacts and ground over time."""
    figure = plt.figure(figsize=(12, 5), constrained_layout=True)
    grid = figure.add_gridspec(3, 2, width_ratios=(1.0, 1.5), height_ratios=(4.0, 0.7, 2.0))
    draw_groups(figure.add_subplot(grid[:, 0]), rows)
    gate = figure.add_subplot(grid[0, 1])
    feet, ground = (figure.add_subplot(grid[row, 1], sharex=gate) for row in (1, 2))
    k = world.lanes.kinds.index(kind)
    t, best = find_furthest(world, watched, k)
    if t.size:
        time = t * world.config.physics.control_period
        draw_gate(gate, time, watched.seen.gate[t, best])
        draw_feet(feet, time, ~watched.seen.airborne[t, best])
        _, levels = recorder.round_robin_lanes(world.lanes, watched.alive.shape[1])
        lane = world.lanes.tile(levels[best], k)
        under = draw_ground(ground, time, lane, watched.seen.pose[t, best, 0])
        for at in time[1:][np.diff(under) != 0.0]:
            gate.axvline(at, color="0.8", lw=0.8, zorder=0)
        for axis in (gate, feet):
            axis.tick_params(labelbottom=False)
        gate.set_title(
            f"{recorder.lane_name(world, kind)}: the robot that walked furthest", fontsize=9
        )
    else:
        gate.set_title(f"no robot on {kind}", fontsize=9)
    figure.savefig(out, dpi=90)


def find_furthest(
    world: World, watched: StepRecords, kind: int
) -> tuple[Int[np.ndarray, " t"], int]:
    """Find the robot that walked furthest on a lane: its steps and its number."""
    x = np.where(watched.alive, watched.seen.pose[..., 0], -np.inf)
    x[:, recorder.round_robin_lanes(world.lanes, x.shape[1])[0] != kind] = -np.inf
    best = int(np.argmax(x.max(axis=0)))
    return np.flatnonzero(np.isfinite(x[:, best])), best


def draw_groups(axis: Axes, rows: list[Row]) -> None:
    """Draw mean and quartiles of each state, in one colour per group."""
    colours = dict(zip(GROUPS, ("C0", "C1", "C2"), strict=True))
    labels, y = [], []
    for k, row in enumerate(rows):
        at = k + 0.8 * list(GROUPS).index(row.group)
        few = " !" if row.note and row.n else ""
        y.append(at)
        labels.append(f"{row.state}\nn = {row.n:,}{few}")
        if row.n:
            axis.barh(at, row.q75 - row.q25, 0.5, row.q25, color=colours[row.group], alpha=0.35)
            axis.plot([row.median] * 2, [at - 0.25, at + 0.25], color=colours[row.group], lw=2)
            axis.plot(row.mean, at, "o", color=colours[row.group], ms=5)
    ends = [x for row in rows if row.n for x in (row.q25, row.q75, row.mean)]
    if ends:
        margin = 0.05 * (max(ends) - min(ends)) + 1e-3
        axis.set_xlim(min(ends) - margin, max(ends) + margin)
    axis.set_yticks(y, labels, fontsize=8)
    axis.invert_yaxis()
    axis.grid(axis="x", alpha=0.3)
    axis.set_xlabel("highway gate, mean over channels (1: memory)")
    axis.set_title(f"dot: mean; line: median; bar: quartiles; !: n below {FEW}", fontsize=9)


def draw_gate(axis: Axes, time: Float[np.ndarray, " t"], gate: Float[np.ndarray, "t 3"]) -> None:
    """Draw the mean over channels; state the 10th to 90th percentile range of the channels."""
    mean, low, high = gate.T
    axis.plot(time, mean, color="C0", lw=1.2)
    axis.set(ylabel="highway gate,\nmean over channels")
    axis.grid(axis="y", alpha=0.3)
    text = f"80 % of the channels are within {low.mean():.2f} to {high.mean():.2f}"
    axis.text(0.99, 0.97, text, transform=axis.transAxes, ha="right", va="top", size=8)
    axis.set_ylim(top=axis.get_ylim()[1] + 0.15 * np.ptp(axis.get_ylim()))


def draw_feet(axis: Axes, time: Float[np.ndarray, " t"], down: Bool[np.ndarray, "t F"]) -> None:
    """Draw when each foot touches the ground."""
    for foot in range(2):
        axis.fill_between(
            time, 0.1 - foot, 0.9 - foot, where=down[:, foot], step="post", color="0.35", lw=0
        )
    axis.set_yticks([0.5, -0.5], ["left", "right"], fontsize=8)
    axis.set(ylabel="foot on\nground", ylim=(-1, 1))


def draw_ground(
    axis: Axes,
    time: Float[np.ndarray, " t"],
    ground: Terrain,
    x: Float[np.ndarray, " t"],
) -> Float[np.ndarray, " t"]:
    """Draw and return the height of the ground under the pelvis over time, m."""
    heights = cross_section.middle_heights(ground)
    under = heights[np.clip((x / ground.cell).astype(int), 0, len(heights) - 1)]
    floor = min(float(under.min()), 0.0) - 0.1
    axis.fill_between(time, floor, under, step="post", color="0.75", lw=0)
    axis.set(xlabel="time, s", ylabel="ground under\nthe pelvis, m")
    axis.set_ylim(floor, float(under.max()) + 0.15)
    axis.grid(axis="y", alpha=0.3)
    return under


if __name__ == "__main__":
    main()
