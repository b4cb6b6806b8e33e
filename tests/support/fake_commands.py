"""Commands that write in milliseconds what `train` and `eval` write, and can be killed at any step.

What they write follows from variant, seed and iteration alone, as it does for the real ones.
"""

import itertools
import json
from pathlib import Path

from cref_jax.evaluation import highway_gate, paper_results
from cref_jax.reproduction.commands import Runner

STEP_S = 0.5  # s per iteration that the log tells of


class Killed(BaseException):
    """SIGKILL: nothing is cleaned up."""


class FakeRunner(Runner):
    """A runner whose commands do one step at a time, and are killed before given steps."""

    def __init__(self, kill_before: int | None = None, stop_before: int | None = None) -> None:
        super().__init__()
        self.log: list[str] = []
        self._steps, self._kill, self._stop = 0, kill_before, stop_before

    def run(self, words: list[str], on_wait=lambda: None) -> int:
        """Run `train` or `eval` by its words."""
        options = dict(itertools.pairwise(words))
        return self._train(words, options) if words[0] == "train" else self._evaluate(options)

    def _step(self, what: str) -> None:
        if self._steps == self._kill:
            raise Killed
        if self._steps == self._stop:
            self.signal = 15
        self._steps += 1
        self.log.append(what)

    def _train(self, words: list[str], options: dict[str, str]) -> int:
        run = Path(options["--run-dir"])
        latest = max((int(p.name) for p in run.glob("checkpoints/*")), default=0)
        assert ("--resume" in words) == (latest > 0)
        if not latest:
            run.mkdir(parents=True, exist_ok=True)
            (run / "last").write_text(options["--iterations"])
        last = int((run / "last").read_text())
        for iteration in range(latest + 1, last + 1):
            self._step(f"{run.name} {iteration}")
            line = {"iteration": iteration, "samples_per_s": 192 / STEP_S, "level/flat": 9.0}
            line["level/gap"] = 0.5 * iteration + len(run.name) / 100.0
            with (run / "log.jsonl").open("a") as log:
                log.write(json.dumps(line) + "\n")
            if iteration % 2 == 0 or self.signal:  # a step in between is lost with the process
                (run / "checkpoints" / str(iteration) / "state").mkdir(parents=True)
            if self.signal:
                return 0
        return 0

    def _evaluate(self, options: dict[str, str]) -> int:
        out, suite = Path(options["--out"]), options["--suite"]
        run = Path(options["--run"])
        iteration = max(int(p.name) for p in run.glob("checkpoints/*"))
        out.mkdir(parents=True, exist_ok=True)
        (out / "eval.json").write_text('{"suite": "tab')  # cut short by a kill
        self._step(f"{run.name} {suite}")
        trials, k = int(options["--num-envs"]), 1 + len(run.name) % 5 + int(run.name[-1])
        build = {"table": lambda: table(trials, k), "gate": lambda: gate(trials, k)}
        policies = [{"iteration": iteration}]
        record = {"suite": suite, "policies": policies, "seconds": 90.0, **build[suite]()}
        (out / "eval.json").write_text(json.dumps(record))
        return 0


def table(trials: int, lost: int, mad: float = 0.03) -> dict:
    """Build a table in which cell n loses `lost` + n of the trials, one of them going up."""
    cells = []
    for number, (kind, level) in enumerate(paper_results.METHODS[paper_results.FULL].success):
        failed = min(lost + number, trials)
        cells.append(
            {
                "kind": kind,
                "level": level,
                "size_m": 0.2,
                "trials": trials,
                "successes": trials - failed,
                "rate": 1.0 - failed / trials,
                "up_failures": 1 if kind == "stairs" else None,
                "down_failures": failed - 1 if kind == "stairs" else None,
            }
        )
    rate = sum(cell["rate"] for cell in cells) / len(cells)
    groups = [
        {"way": way, "size_m": size, "foot": foot, "touchdowns": n, "mad_m": mad + offset}
        for way, n in (("up", 40), ("down", 60))
        for size, offset in ((0.15, 0.5), (0.2, 0.0))
        for foot in ("left", "both")
    ]
    return {"cells": cells, "overall": {"rate": rate}, "touchdowns": {"groups": groups}}


def gate(robots: int, shift: int = 0) -> dict:
    """Build a gate record: 0.40 and 0.01 more for each further state of a group."""
    rows = [
        {"group": group, "state": state, "n": 100, "robots": robots}
        | {"mean": 0.40 + 0.01 * k + 0.001 * shift}
        for group, states in highway_gate.GROUPS.items()
        for k, state in enumerate(states)
    ]
    return {"robots": robots, "gate": rows}
