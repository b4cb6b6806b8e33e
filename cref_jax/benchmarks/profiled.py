"""The training program with one of its calls traced, and its time by stage as JSON."""

import collections
import json
import shutil
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
from jax.profiler import ProfileData
from jax.sharding import Mesh

from cref_jax.benchmarks import hlo, stage_times
from cref_jax.env.world import World
from cref_jax.training import iteration, processes, trainer
from cref_jax.training.progress import Reporter, SilentReporter

TRACED_CALL = 2  # the first one also loads kernels
IDLE = "idle"


def build_programs(
    world: World, mesh: Mesh, report: Reporter | SilentReporter, folder: Path | None
) -> trainer.Programs:
    """Build the programs of a run; with a folder for its profile, one of their calls is traced."""
    if folder is None:
        return trainer.Programs(world, mesh, report)
    return ProfiledPrograms(world, mesh, report, folder)


class ProfiledPrograms(trainer.Programs):
    """The programs of a run, whose second call is traced in the first process."""

    def __init__(
        self, world: World, mesh: Mesh, report: Reporter | SilentReporter, folder: Path
    ) -> None:
        """Set up JAX for programs that can be traced; results are written to `folder`."""
        super().__init__(world, mesh, report)
        self._folder, self._calls = folder, 0
        # stages are found by whole stacks, which a program in the cache may lack
        jax.config.update("jax_traceback_in_locations_limit", -1)
        jax.config.update("jax_compilation_cache_include_metadata_in_key", True)

    def get(self, size: int) -> trainer.Program:
        """Compile the program of `size` iterations, once, and count its calls."""
        program: Any = super().get(size)

        def call(
            world: World, state: iteration.RunState
        ) -> tuple[iteration.RunState, iteration.Log]:
            self._calls += 1
            if self._calls != TRACED_CALL or not processes.is_first():
                return program(world, state)
            parts = size * len(self.mesh.local_devices)
            result, line = trace_call(program, (world, state), size, parts, self._folder)
            self._report.say(line)
            return result

        return call


def trace_call(
    program: jax.stages.Compiled,
    arguments: tuple[Any, ...],
    iterations: int,
    parts: int,
    folder: Path,
) -> tuple[Any, str]:
    """Call the program under JAX's profiler, and write stages.json and trace.json.gz to `folder`.

    Its time is divided by `iterations`, that of its stages by `parts`: each device has its own.
    Returns the program's results and a line to be printed. Training is worth more than its
    profile: an error of the profiler is said in the line alone.
    """
    with tempfile.TemporaryDirectory() as traces:
        try:
            jax.profiler.start_trace(traces)
        except Exception as error:
            return program(*arguments), _describe_failure(error)
        started_at = time.perf_counter()
        result = jax.block_until_ready(program(*arguments))
        seconds = (time.perf_counter() - started_at) / iterations
        try:
            jax.profiler.stop_trace()
            (binary,) = Path(traces).glob("**/*.xplane.pb")
            source = hlo.Program(program.as_text() or "")
            sums = stage_times.time_stages(ProfileData.from_file(str(binary)).planes, source)
            record = summarize({name: s / parts for name, s in sums.items()}, seconds)
            (folder / "stages.json").write_text(json.dumps(record, indent=2) + "\n")
            for readable in Path(traces).glob("**/*.trace.json.gz"):
                shutil.copy(readable, folder / "trace.json.gz")
        except Exception as error:
            return result, _describe_failure(error)
    shares = ", ".join(f"{name} {of['percent']:.0f} %" for name, of in record["stages"].items())
    line = f"traced: {record['ms_per_iteration']:,.0f} ms per iteration: {shares}"
    return result, f"{line}; see {folder / 'stages.json'}"


def summarize(seconds: Mapping[str, float], whole: float) -> dict[str, Any]:
    """Build the record of an iteration that took `whole` s, from those that each part took.

    A stage is the sum of the parts before whose colon it stands, such as "physics: rest"; `IDLE` is
    what is left of the whole. Where threads take turns on a core, the parts may sum up to more:
    then they are the whole.
    """
    parts = {**seconds, IDLE: max(whole - sum(seconds.values()), 0.0)}
    stages, total = collections.Counter(), sum(parts.values())
    for name, s in parts.items():
        stages[name.partition(":")[0]] += s
    figures = lambda s: {"ms": round(1e3 * s, 3), "percent": round(100.0 * s / total, 1)}
    return {
        "ms_per_iteration": round(1e3 * whole, 3),
        "stages": {name: figures(s) for name, s in stages.most_common()},
        "parts": {name: figures(s) for name, s in parts.items()},
    }


def _describe_failure(error: Exception) -> str:
    return " ".join(f"warning: no profile: {type(error).__name__}: {error}".split())
