"""Parallel jobs, one worker process per core.

For work dominated by many small numpy calls, which the threads of one interpreter cannot run in
parallel. Each process is a fresh interpreter, since JAX does not survive a fork, and builds its
worker once.
"""

import concurrent.futures
import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import loky
from rich.progress import track

J = TypeVar("J")
R = TypeVar("R")


def cores() -> int:
    """Count the cores available to this process, by affinity and by its container's quota."""
    return loky.cpu_count()


def run(
    make: Callable[..., Callable[[J], R]],
    arguments: tuple[Any, ...],
    jobs: Sequence[J],
    count: int | None = None,
) -> list[R]:
    """Apply a worker, `make(*arguments)`, to each job, with a progress bar.

    Args:
        make: a module-level class or function, so that another process can import it.
        arguments: picklable, as jobs and results must be.
        jobs: the inputs; results come in the same order.
        count: number of processes, by default one per core; 1 runs all jobs in this process.
    """
    count = min(count or cores(), len(jobs))
    collect = lambda results: list(track(results, "walking", len(jobs), transient=True))
    if count == 1:
        return collect(map(make(*arguments), jobs))
    others = set(multiprocessing.active_children())
    pool = concurrent.futures.ProcessPoolExecutor(
        count, multiprocessing.get_context("spawn"), _start_worker, (make, arguments)
    )
    try:
        with _without_interrupts():
            futures = [pool.submit(_run_job, job) for job in jobs]
        return collect(future.result() for future in futures)
    except BaseException:  # such as Ctrl-C: do not wait for the other jobs
        for child in set(multiprocessing.active_children()) - others:
            child.kill()
        raise
    finally:
        pool.shutdown()


_worker: Callable[[Any], Any] | None = None  # one per process


def _start_worker(make: Callable[..., Callable[[Any], Any]], arguments: tuple[Any, ...]) -> None:
    global _worker
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _worker = make(*arguments)


def _end_with_parent() -> None:
    """Exit when the parent process ends: after Ctrl-C nothing else stops a worker."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Block Ctrl-C in processes started here: each would print a traceback."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _run_job(job: Any) -> Any:
    assert _worker is not None
    return _worker(job)
