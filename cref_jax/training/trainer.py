"""The training loop: compiled chunks, with checkpoints and health checks in between."""

import contextlib
import time
from collections.abc import Callable, Mapping

import jax
import numpy as np
from jax.sharding import Mesh

from cref_jax import errors
from cref_jax.env.world import World
from cref_jax.system import interrupts
from cref_jax.training import devices, iteration, processes
from cref_jax.training.checkpoint import Checkpoints
from cref_jax.training.progress import Reporter, SilentReporter

MAX_UNSTABLE = 0.01  # share of an iteration's samples; assumed: more is systematic

Program = Callable[[World, iteration.RunState], tuple[iteration.RunState, iteration.Log]]


class Programs:
    """The compiled programs of chunks of iterations, by size."""

    def __init__(self, world: World, mesh: Mesh, report: Reporter | SilentReporter) -> None:
        self._world, self.mesh, self._report = world, mesh, report
        self._shapes = iteration.state_shapes(world, mesh)
        self._compiled: dict[int, jax.stages.Compiled] = {}

    def get(self, size: int) -> Program:
        """Compile the program of `size` iterations, once; report time and memory of the first.

        Raises:
            ConfigError: it needs more memory than the device has.
        """
        if size not in self._compiled:
            first = not self._compiled
            if first:
                self._report.say(
                    "compiling (half a minute on four cores, seconds from the cache) ..."
                )
            started_at = time.monotonic()
            lowered = iteration.chunk.lower(self._world, self._shapes, self.mesh, size)
            self._compiled[size] = lowered.compile()
            processes.wait_for_all()
            if first:
                seconds = time.monotonic() - started_at
                robots = self._world.config.run.num_envs
                needed = devices.check_memory(
                    self._compiled[size], robots, len(self.mesh.local_devices)
                )
                self._report.say(
                    f"compiled in {seconds:.0f} s; needs {needed / 2**30:.1f} GiB of memory; "
                    "Ctrl-C saves and stops"
                )
        return self._compiled[size]


def run_chunks(
    world: World,
    state: iteration.RunState,
    steps: Checkpoints,
    report: Reporter | SilentReporter,
    programs: Programs,
    stop: interrupts.StopRequest | None = None,
) -> iteration.RunState:
    """Train chunk by chunk; save in between, at the end, when asked to stop, and on an error.

    `stop` says afterwards whether a process was asked to.
    """
    c = world.config
    done = int(state.train.iteration)
    if done >= c.run.iterations:
        report.say(f"nothing left to do: {done} of {c.run.iterations} iterations are done")
        return state
    saved = time.monotonic()
    stops = False
    with stop or interrupts.StopRequest() as stop:
        try:
            while done < c.run.iterations and not stops:
                program = programs.get(min(c.run.chunk, c.run.iterations - done))
                started_at = time.monotonic()
                state, log = program(world, state)
                log = {name: np.asarray(values) for name, values in log.items()}
                try:
                    report.chunk(done, log, time.monotonic() - started_at)
                finally:  # what is not sound is not saved, whatever else fails
                    check_health(log, c.run.num_envs * c.ppo.horizon)
                done = int(state.train.iteration)
                is_due = time.monotonic() - saved > 60 * c.run.checkpoint_minutes
                stops, is_due = processes.any_says(stop.requested, is_due)
                stop.requested = stops
                if is_due:
                    _save(steps, state, done, programs.mesh)
                    saved = time.monotonic()
        except (errors.TrainingError, errors.CheckpointError):
            raise
        except (Exception, SystemExit):  # rich's answer to a closed pipe is SystemExit
            _rescue(steps, state, report, programs.mesh)
            raise
        _save(steps, state, done, programs.mesh)
    if stops:
        report.say(f"stopped and saved at iteration {done}")
    return state


def _save(steps: Checkpoints, state: iteration.RunState, done: int, mesh: Mesh) -> None:
    steps.save(done, state, describe_sharding(state, mesh))
    processes.wait_for_all()


def _rescue(
    steps: Checkpoints, state: iteration.RunState, report: Reporter | SilentReporter, mesh: Mesh
) -> None:
    """Save what was learned before an error, unless it struck within a chunk or other processes."""
    if jax.process_count() > 1 or any(leaf.is_deleted() for leaf in jax.tree.leaves(state)):
        return
    done = int(state.train.iteration)
    _save(steps, state, done, mesh)
    with contextlib.suppress(OSError):  # the terminal may be gone
        report.say(f"saved at iteration {done}, before an error")


def describe_sharding(state: iteration.RunState, mesh: Mesh) -> dict[str, int]:
    """Describe how robots are sharded; each device cycles through the kinds of lane."""
    return {"num_envs": state.robots.begins.shape[0], "shares": mesh.size}


def check_health(log: Mapping[str, np.ndarray], samples: int) -> None:
    """Check that simulation and update are sound, before they are saved.

    Raises:
        TrainingError: too many simulations were unstable, or no gradient was finite.
    """
    unstable = float(log["episode/unstable"].max()) / samples
    if unstable > MAX_UNSTABLE:
        raise errors.TrainingError(
            f"the physics blew up in {unstable:.1%} of the samples; the last checkpoint is good"
        )
    if float(log["loss/skipped"].min()) == 1.0:
        raise errors.TrainingError("no gradient was finite; the last checkpoint is good")
