"""Draw the learning curves of runs: `python experiments/curves.py runs/A runs/B --out flat.png`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import tyro

from cref_jax import curves

SMOOTH = 10  # iterations that a point is the mean of
SHOWN = {
    "episode/length_s": "episode length, s",
    "walk/speed_error": "speed error with exploration, m/s",
    "walk/airborne": "share of time a foot is off the ground",
    "walk/reward": "reward a step",
}


@dataclass(frozen=True)
class Options:
    """Draw learning curves over the minutes that the iterations took."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """folders of runs"""
    out: Path = Path("curves.png")
    """the picture to write"""


def main() -> None:
    """Read each run's log and draw it."""
    options = tyro.cli(Options)
    figure, axes = plt.subplots(1, len(SHOWN), figsize=(4 * len(SHOWN), 3), constrained_layout=True)
    for run in options.runs:
        log = curves.read(run / "log.jsonl")
        label = f"{run.name}, {log['train/samples'][-1] / 1e6:.1f} M"
        for axis, name in zip(axes, SHOWN, strict=True):
            mean = curves.smooth(log, name, SMOOTH)
            axis.plot(log.minutes()[SMOOTH - 1 :], mean[SMOOTH - 1 :], label=label)
    for axis, title in zip(axes, SHOWN.values(), strict=True):
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("minutes")
        axis.set_ylim(bottom=0.0)
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.savefig(options.out, dpi=110)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
