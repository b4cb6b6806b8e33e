"""Plot the figures of `make bench ARGS="--out bench.json"`: `python experiments/bench.py`."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import tyro

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Options:
    """Plot the time of each stage per robot step, and its share of the machine's bound."""

    measured: Path = HERE / "bench.json"
    """JSON file written by the benchmark"""
    out: Path = HERE / "figures" / "bench.png"
    """image to write"""


def main() -> None:
    """Read the figures and plot them."""
    options = tyro.cli(Options)
    record = json.loads(options.measured.read_text())
    figure, (times, shares) = plt.subplots(
        1, 2, figsize=(11, 5), sharey=True, constrained_layout=True
    )
    stages = list(dict.fromkeys(row["stage"] for row in record["rows"]))[::-1]
    counts = sorted({row["robots"] for row in record["rows"]})
    for k, count in enumerate(counts):
        rows = [row for row in record["rows"] if row["robots"] == count]
        height = 0.8 / len(counts)
        y = [stages.index(row["stage"]) + (k - 0.5 * (len(counts) - 1)) * height for row in rows]
        microseconds = [1e6 * row["seconds"] / count for row in rows]
        times.barh(y, microseconds, height, label=f"{count} robots")
        share = [100.0 * (row["share"] or 0.0) for row in rows]
        shares.barh(y, share, height)
    times.set_yticks(range(len(stages)), stages)
    times.set_xlabel("µs per control step of a robot, on all cores")
    times.legend(loc="center right", reverse=True)  # as the bars are drawn, from below
    shares.set_xlabel("% of the machine's bound, where known")
    figure.suptitle(_title(record))
    figure.savefig(options.out, dpi=100)


def _title(record: dict[str, Any]) -> str:
    products = record["rates"]["products"] / 1e9
    return f"{record['terrain']}, {record['machine']}, {products:,.0f} GFLOP/s per device"


if __name__ == "__main__":
    main()
