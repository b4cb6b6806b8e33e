"""Time of each stage of a compiled program, from a trace of its run by JAX's profiler.

The profiler names the instruction that it times, and the program's text says from which source that
was traced. On a GPU the kernels on its streams count; on a CPU the instructions on XLA's threads,
less those within them and less what a thread waits.
"""

import collections
import functools
import re
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

from cref_jax.benchmarks import hlo, source_stages
from cref_jax.benchmarks.source_stages import REST

WARP_KERNEL = "_cuda_kernel_"  # in the name of every kernel that Warp compiles
WARP_STAGE = "physics: MuJoCo Warp"


class Event(NamedTuple):
    """A timed stretch of a thread or stream."""

    name: str
    instruction: str | None  # of the program, if it is known
    nanoseconds: float  # without the events within it


class StageFinder:
    """Finds the stage that an event of a program belongs to."""

    def __init__(self, program: hlo.Program) -> None:
        self._stacks = program.stacks()
        self._kernels = {re.sub(r"\W", "_", name): name for name in self._stacks}
        self._stage = functools.cache(self._find)

    def find(self, event: Event) -> str:
        """Return the event's stage by its instruction, else by its name; `REST` if unknown.

        In a CUDA graph a kernel is known by its name alone, which is that of its instruction.
        """
        if event.instruction in self._stacks:
            return self._stage(event.instruction)
        if WARP_KERNEL in event.name:
            return WARP_STAGE
        name = self._kernels.get(event.name)
        return REST if name is None else self._stage(name)

    def _find(self, instruction: str) -> str:
        """Return the stage of the instruction, or of the first of its callers that has one."""
        stages = map(source_stages.stage_of, self._stacks[instruction])
        return next((stage for stage in stages if stage != REST), REST)


def time_stages(planes: Iterable[Any], program: hlo.Program) -> dict[str, float]:
    """Sum the time of each stage over all streams of GPUs or threads of the CPU, s; longest first.

    `planes` are those of a `jax.profiler.ProfileData`. What happens at the same time on several
    streams or threads counts for each of them.
    """
    finder, planes = StageFinder(program), list(planes)
    sums: collections.Counter[str] = collections.Counter()
    gpus = [plane for plane in planes if plane.name.startswith("/device:GPU")]
    for plane in gpus or planes:
        for line in plane.lines:
            if not gpus or line.name.startswith("Stream"):
                for event in self_times(line.events):
                    if gpus or event.instruction is not None:
                        sums[finder.find(event)] += event.nanoseconds
    return {name: 1e-9 * nanoseconds for name, nanoseconds in sums.most_common()}


def self_times(events: Iterable[Any]) -> Iterator[Event]:
    """Yield the events of one thread with their time less that of the events within them."""
    open_: list[tuple[float, Any, list[float]]] = []  # end, event, time within it

    def close() -> Event:
        _, event, inside = open_.pop()
        instruction = next((value for key, value in event.stats if key == "hlo_op"), None)
        return Event(event.name, instruction, event.duration_ns - sum(inside))

    for event in sorted(events, key=lambda e: (e.start_ns, -e.duration_ns)):
        while open_ and open_[-1][0] <= event.start_ns:
            yield close()
        if open_:
            open_[-1][2].append(event.duration_ns)
        open_.append((event.start_ns + event.duration_ns, event, []))
    while open_:
        yield close()
