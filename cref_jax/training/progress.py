"""Progress of a run: a live display on a terminal, plain lines elsewhere, and log files."""

import contextlib
import json
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from tensorboardX import SummaryWriter

from cref_jax.system import disk
from cref_jax.training.wandb_log import WandbLog

PLAIN_SECONDS = 20.0  # between two lines without a terminal
SHOWN = {  # name in the log: name on the screen and unit
    "walk/speed_error": ("speed error", "m/s"),
    "walk/forward_speed": ("forward speed", "m/s"),
    "episode/length_s": ("episode length", "s"),
    "episode/falls_per_minute": ("falls", "per minute"),
    "walk/reward": ("reward", "per step"),
    "train/action_std": ("action deviation", ""),
    "loss/kl": ("KL", "nats"),
    "teacher_kl/mean": ("KL from the teachers", "nats"),
    "loss/imitation": ("imitation error", "over all joints"),
    "train/teacher_samples": ("samples of the teacher", ""),
    "train/student_samples": ("samples of the student", ""),
    "train/learning_rate": ("learning rate", ""),
}


class Reporter:
    """Writes every iteration to `log.jsonl`, TensorBoard and W&B, and shows the latest figures."""

    def __init__(
        self,
        run: Path,
        first: int,
        last: int,
        samples: int,
        before: int = 0,
        tensorboard: bool = True,
        wandb: Mapping[str, Any] | None = None,
    ) -> None:
        """Report iterations `first` to `last`, of `samples` samples each, after those of `before`.

        `wandb` are the settings of the run that its log at Weights & Biases shows, if it has one.
        """
        self.console = Console()
        path = run / "log.jsonl"
        self._file = disk.append_lines(path) if first else path.open("w", encoding="utf-8")
        self._board = SummaryWriter(str(run / "tensorboard")) if tensorboard else None
        self._wandb = WandbLog(run, wandb, self.say) if wandb is not None else None
        self._last, self._samples, self._before = last, samples, before - first * samples
        self._live: Live | None = None
        self._bar = Progress(
            TextColumn("iteration"),
            MofNCompleteColumn(),
            BarColumn(),
            TextColumn("{task.fields[rate]}"),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=self.console,
            auto_refresh=False,
        )
        self._task = self._bar.add_task("train", total=last, completed=first, rate="")
        self._printed_at = 0.0

    def __enter__(self) -> "Reporter":
        if self.console.is_terminal:
            self._live = Live(self._bar, console=self.console, refresh_per_second=4)
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with contextlib.ExitStack() as closing:  # each, even where the terminal is gone
            closing.callback(self._file.close)
            if self._board:
                closing.callback(self._board.close)
            if self._wandb:
                closing.callback(self._wandb.close)
            if self._live:
                closing.callback(self._live.stop)

    def say(self, line: str) -> None:
        """Print one line above the table."""
        self.console.print(line, markup=False, highlight=False, soft_wrap=True)

    def chunk(self, first: int, log: Mapping[str, np.ndarray], seconds: float) -> None:
        """Report the iterations from `first` + 1 on, which took `seconds` in total."""
        count = len(next(iter(log.values())))
        rate = count * self._samples / seconds
        for i in range(count):
            iteration = first + i + 1
            row = {name: float(values[i]) for name, values in log.items()}
            row["train/samples"] = float(self._before + iteration * self._samples)
            line = {"iteration": iteration, "samples_per_s": round(rate), **_round_row(row)}
            self._file.write(json.dumps(line) + "\n")
            if self._board:
                for name, value in row.items():
                    self._board.add_scalar(name, value, iteration)
            if self._wandb:
                self._wandb.log(row, iteration)
        self._file.flush()
        self._show(first + count, {name: float(v.mean()) for name, v in log.items()}, rate)

    def _show(self, iteration: int, newest: Mapping[str, float], rate: float) -> None:
        self._bar.update(self._task, completed=iteration, rate=f"{rate:,.0f} samples/s")
        if self._live:
            self._live.update(Group(self._bar, _build_table(newest)))
        elif time.monotonic() - self._printed_at > PLAIN_SECONDS or iteration >= self._last:
            self._printed_at = time.monotonic()
            task = self._bar.tasks[0]
            left = f", {task.time_remaining / 60:.0f} min left" if task.time_remaining else ""
            figures = ", ".join(
                f"{title} {newest[name]:.3g}{' ' + unit if unit else ''}"
                for name, (title, unit) in SHOWN.items()
                if name in newest
            )
            self.say(f"{iteration}/{self._last}: {rate:,.0f} samples/s{left}; {figures}")


class SilentReporter:
    """Reports nothing: of several processes one alone does."""

    def __enter__(self) -> "SilentReporter":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def say(self, line: str) -> None:
        """Say nothing."""

    def chunk(self, first: int, log: Mapping[str, np.ndarray], seconds: float) -> None:
        """Write nothing."""


def _build_table(newest: Mapping[str, float]) -> Table:
    """Build the table of figures, and of level and falls by kind of terrain."""
    table = Table.grid(padding=(0, 2))
    for name, (title, unit) in SHOWN.items():
        if name in newest:
            table.add_row(title, f"{newest[name]:.4g} {unit}")
    for name, level in newest.items():
        if name.startswith("level/"):
            kind = name.removeprefix("level/")
            table.add_row(kind, f"level {level:.1f}, {newest[f'fell/{kind}']:.0%} of episodes fall")
    return table


def _round_row(row: Mapping[str, float]) -> dict[str, float | None]:
    """Round to six digits; None for non-finite numbers, which JSON cannot hold."""
    return {k: float(f"{v:.6g}") if np.isfinite(v) else None for k, v in row.items()}
