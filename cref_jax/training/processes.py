"""Processes that train together, each on its own host or with its own devices.

All run the same program on the same settings. The first one alone writes files and talks; what
depends on a clock or a signal is decided by all.
"""

import itertools
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree
from orbax.checkpoint import multihost

from cref_jax.errors import ConfigError

LONGEST_WAIT = 3600.0  # s; assumed: compiling on busy cores takes minutes
PATIENCE = 45  # s without a sign of life until a process counts as lost; an exchange waits for 30

_barriers = itertools.count()  # each has a name of its own, the same in all processes


def join(
    coordinator: str | None = None, count: int | None = None, number: int | None = None
) -> None:
    """Join the other processes, before JAX is used.

    Args:
        coordinator: host:port of process 0; without it, Slurm, Open MPI or Kubernetes are asked.
        count: processes in all.
        number: of this one, from 0.

    Raises:
        ConfigError: there is nobody to ask, or the coordinator does not answer.
    """
    given = [x is not None for x in (coordinator, count, number)]
    if any(given) and not all(given):
        raise ConfigError("give --coordinator, --num-processes and --process-id, or none of them")
    if count is not None and number is not None and not 0 <= number < count:
        raise ConfigError(f"--process-id must be 0 to {count - 1}, not {number}")
    try:
        jax.distributed.initialize(
            coordinator, count, number,
            heartbeat_timeout_seconds=PATIENCE, shutdown_timeout_seconds=PATIENCE,
        )  # fmt: skip
    except (ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(
            f"no other processes: {reason} Give --coordinator HOST:PORT, --num-processes and "
            "--process-id where neither Slurm, Open MPI nor Kubernetes starts the program"
        ) from None


def leave() -> None:
    """Part from the other processes, at the same moment as they do."""
    if jax.distributed.is_initialized():
        jax.distributed.shutdown()


def is_first() -> bool:
    """Check whether this process writes and talks."""
    return jax.process_index() == 0


def wait_for_all() -> None:
    """Wait until all processes are here, however long one compiles or writes.

    An exchange of gradients itself waits for half a minute alone.
    """
    if jax.process_count() > 1:
        client = multihost.get_jax_distributed_client()
        client.wait_at_barrier(f"cref_jax {next(_barriers)}", int(1e3 * LONGEST_WAIT))


def any_says(*flags: bool) -> list[bool]:
    """Decide together: whether any process says so, for each flag."""
    if jax.process_count() == 1:
        return list(flags)
    said = multihost_utils.process_allgather(np.array(flags))
    return [bool(flag) for flag in np.any(said, axis=0)]


def replicate(tree: PyTree, mesh: Mesh) -> PyTree:
    """Put a tree on all devices of a mesh; the first process's values count."""
    place = NamedSharding(mesh, PartitionSpec())
    if jax.process_count() == 1:
        return jax.device_put(tree, place)
    put = lambda x: jax.make_array_from_callback(x.shape, place, lambda part: x[part])
    return jax.tree.map(put, multihost_utils.broadcast_one_to_all(tree))


def to_host(tree: PyTree) -> PyTree:
    """Copy arrays, whichever processes hold their parts, to numpy; called by all processes."""
    apart = lambda x: not (x.is_fully_addressable or x.is_fully_replicated)
    gather = lambda x: multihost_utils.process_allgather(x, tiled=True)
    whole = lambda x: gather(x) if isinstance(x, jax.Array) and apart(x) else x
    return jax.device_get(jax.tree.map(whole, tree))


@contextmanager
def ending_together() -> Iterator[None]:
    """End this process at once if it fails or another one is lost: the rest must not wait for it.

    Where the loss is not noticed by an exchange of gradients, JAX ends the process itself.
    """
    try:
        yield
    except (SystemExit, jax.errors.JaxRuntimeError) as error:
        if not jax.distributed.is_initialized() or getattr(error, "code", 1) in (0, None):
            raise
        if isinstance(error, jax.errors.JaxRuntimeError):
            reason = str(error).splitlines()[0][:160]
            print(
                f"error: another process of this run was lost: {reason}; the last checkpoint is "
                "good, go on from it with --resume on as many processes as there are",
                file=sys.stderr,
            )
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(int(getattr(error, "code", 1)))
