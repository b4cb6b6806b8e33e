"""The training loop: compiled chunks, checkpoints in between, a check of health."""

import time
from collections.abc import Mapping

import jax
import numpy as np
from jax.sharding import Mesh

from cref_jax import errors
from cref_jax.env.world import World
from cref_jax.system import interrupts
from cref_jax.training import devices, iteration
from cref_jax.training.checkpoint import Checkpoints
from cref_jax.training.progress import Reporter

MAX_UNSTABLE = 0.01  # share of an iteration's samples; assumed: more is no accident


class Programs:
    """The compiled programs of chunks of iterations."""

    def __init__(self, world: World, mesh: Mesh, report: Reporter) -> None:
        self._world, self.mesh, self._report = world, mesh, report
        self._shapes = iteration.shapes(world, mesh)
        self._of: dict[int, jax.stages.Compiled] = {}

    def of(self, size: int) -> jax.stages.Compiled:
        """Return the program of `size` iterations; the first one is announced and weighed.

        Raises:
            ConfigError: it needs more memory than there is.
        """
        if size not in self._of:
            first = not self._of
            if first:
                self._report.say(
                    "compiling (half a minute on four cores, seconds from the cache) ..."
                )
            begun = time.monotonic()
            lowered = iteration.chunk.lower(self._world, self._shapes, self.mesh, size)
            self._of[size] = lowered.compile()
            if first:
                seconds = time.monotonic() - begun
                robots = self._world.config.run.num_envs
                needed = devices.check_memory(self._of[size], robots, self.mesh.size)
                self._report.say(
                    f"compiled in {seconds:.0f} s; it takes {needed / 2**30:.1f} GiB of memory; "
                    "Ctrl-C saves and stops"
                )
        return self._of[size]


def run_chunks(
    world: World,
    state: iteration.RunState,
    steps: Checkpoints,
    report: Reporter,
    programs: Programs,
) -> iteration.RunState:
    """Train chunk by chunk; save in between, at the end, and when asked to stop."""
    c = world.config
    done = int(state.train.iteration)
    if done >= c.run.iterations:
        report.say(f"nothing left to do: {done} of {c.run.iterations} iterations are done")
        return state
    saved = time.monotonic()
    with interrupts.StopRequest() as stop:
        while done < c.run.iterations and not stop.asked:
            program = programs.of(min(c.run.chunk, c.run.iterations - done))
            begun = time.monotonic()
            state, log = program(world, state)
            log = {name: np.asarray(values) for name, values in log.items()}
            report.chunk(done, log, time.monotonic() - begun)
            check_health(log, c.run.num_envs * c.ppo.horizon)
            done = int(state.train.iteration)
            if time.monotonic() - saved > 60 * c.run.checkpoint_minutes:
                _save(steps, state, done, programs.mesh)
                saved = time.monotonic()
        _save(steps, state, done, programs.mesh)
    if stop.asked:
        report.say(f"stopped and saved at iteration {done}")
    return state


def _save(steps: Checkpoints, state: iteration.RunState, done: int, mesh: Mesh) -> None:
    steps.save(done, state, sharing(state, mesh))


def sharing(state: iteration.RunState, mesh: Mesh) -> dict[str, int]:
    """Return how the robots are shared out; each device has the kinds of lane in turn."""
    return {"num_envs": state.robots.begins.shape[0], "shares": mesh.size}


def check_health(log: Mapping[str, np.ndarray], samples: int) -> None:
    """Stop before a broken simulation or update is saved.

    Raises:
        TrainingError: too many robots blew up, or no gradient was finite.
    """
    unstable = float(log["episode/unstable"].max()) / samples
    if unstable > MAX_UNSTABLE:
        raise errors.TrainingError(
            f"the physics blew up in {unstable:.1%} of the samples; the last checkpoint is good"
        )
    if float(log["loss/skipped"].min()) == 1.0:
        raise errors.TrainingError("no gradient was finite; the last checkpoint is good")
