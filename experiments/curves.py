"""Plot the learning curves of runs: `python experiments/curves.py runs/A runs/B --out flat.png`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro

from cref_jax.pages import training_log

TITLES = {
    "episode/length_s": "episode length, s",
    "walk/speed_error": "speed error with exploration, m/s",
    "walk/airborne": "share of time in the air per foot",
    "walk/reward": "reward per step",
    "level/gap": "gap, mean level of 9",
    "level/platform": "platform, mean level of 9",
    "level/stairs_up": "stairs up, mean level of 9",
    "level/stairs_down": "stairs down, mean level of 9",
}


@dataclass(frozen=True)
class Options:
    """Plot learning curves, one panel per measure."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """run folders"""
    show: tuple[str, ...] = tuple(TITLES)[:4]
    """columns of the log, such as level/gap"""
    over: Literal["minutes", "samples"] = "minutes"
    """x axis: training time without pauses, or samples"""
    smooth: int = 10
    """iterations averaged per point"""
    out: Path = Path("curves.png")
    """image to write"""


def main() -> None:
    """Read the log of each run and plot it."""
    options = tyro.cli(Options)
    size = (4 * len(options.show), 3)
    figure, axes = plt.subplots(1, len(options.show), figsize=size, constrained_layout=True)
    axes = np.atleast_1d(axes)
    for run in options.runs:
        log = training_log.read(run / "log.jsonl")
        millions = log["train/samples"] / 1e6
        over = log.minutes() if options.over == "minutes" else millions
        for axis, name in zip(axes, options.show, strict=True):
            mean = training_log.smooth(log, name, options.smooth)
            full = slice(options.smooth - 1, None)
            axis.plot(over[full], mean[full], label=f"{run.name}, {millions[-1]:.1f} M")
    for axis, name in zip(axes, options.show, strict=True):
        axis.set_title(TITLES.get(name, name), fontsize=10)
        axis.set_xlabel("minutes" if options.over == "minutes" else "samples, M")
        axis.set_ylim(bottom=0.0)
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.savefig(options.out, dpi=110)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
