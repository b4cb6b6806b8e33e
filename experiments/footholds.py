"""Draw foothold candidates on several obstacles: `python experiments/footholds.py`."""

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.axes import Axes

from cref_jax import config, terrain
from cref_jax.env import footholds
from cref_jax.terrain import generators, lanes

SIZES = {"stairs_up": 0.15, "stairs_down": 0.15, "gap": 0.5, "slope": 0.3}  # m; m/m for the slope
BEFORE = 0.2  # m from the sole's centre to the obstacle


@dataclass(frozen=True)
class Options:
    """Draw the candidates of a foot at liftoff before stairs, a gap and a slope."""

    command: float = 0.6
    """commanded forward speed, m/s"""
    out: Path = Path(__file__).parent / "figures" / "footholds.png"
    """image to write"""


def main() -> None:
    """Draw one panel per obstacle."""
    options = tyro.cli(Options)
    figure, axes = plt.subplots(2, 2, figsize=(10, 6.4), constrained_layout=True)
    for axis, (kind, size) in zip(axes.flat, SIZES.items(), strict=True):
        draw(axis, kind, size, options.command)
    axes[0, 0].legend(fontsize=7, loc="upper left")
    figure.savefig(options.out, dpi=90)
    print(f"wrote {options.out}")


def draw(axis: Axes, kind: str, size: float, command: float) -> None:
    """Draw the ground, the buffer points and the window means in the foot frame."""
    c = config.Config()
    ground = lanes.build_single(config.Terrain(name="mixed"), kind, size).tile(0, 0)
    lane_x = np.arange(0.0, 6.0, 0.002)
    height = terrain.height_at(ground, jnp.stack([lane_x, jnp.zeros(lane_x.size)], axis=-1))
    start = lane_x[np.argmax(np.abs(height) > 1e-6)] - BEFORE
    sole = jnp.broadcast_to(jnp.array([start, 0.0, 0.0]), (2, 3))
    candidates = footholds.candidates(ground, sole, jnp.zeros(2), jnp.float32(command), c.foothold)

    x = (np.arange(c.foothold.points[0]) + 0.5) * c.foothold.spacing[0]
    gate = c.foothold.gate_time * command
    z = terrain.height_at(ground, jnp.stack([start + x, jnp.zeros(x.size)], axis=-1))
    ok = np.asarray(candidates.accepted[0])
    mean = np.stack([candidates.x[0], candidates.z[0]])
    rejected = ~ok & (mean[0] >= gate)  # the other windows have no point beyond the gate
    axis.plot(lane_x - start, height, color="0.6", lw=1, zorder=1)
    axis.plot([-0.095, 0.095], [0.0, 0.0], color="k", lw=5, solid_capstyle="butt", label="sole")
    axis.scatter(x[x >= gate], z[x >= gate], s=5, color="tab:blue", label="points", zorder=2)
    axis.scatter(x[x < gate], z[x < gate], s=5, color="0.8", label="points before the gate")
    axis.scatter(
        *mean[:, rejected],
        marker="x",
        color="red",
        s=20,
        lw=0.7,
        label="window, rejected",
        zorder=3,
    )
    axis.scatter(*mean[:, ok], color="green", s=40, label="window, accepted", zorder=4)
    axis.axvline(gate, color="0.7", lw=0.8, ls="--")
    near = height[(lane_x > start - 0.2) & (lane_x < start + 1.3)]
    axis.set(xlim=(-0.2, 1.3), ylim=(near.min() - 0.1, near.max() + 0.1))
    axis.set(xlabel="x, m", ylabel="z, m", title=f"{kind} {generators.format_size(kind, size)}")
    axis.set_aspect("equal")
    axis.grid(alpha=0.3)


if __name__ == "__main__":
    main()
