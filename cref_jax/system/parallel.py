"""The same work many times over, in a process a core.

For work that is half numpy's many small calls, which threads of one interpreter take turns at. Each
process is a fresh interpreter, since JAX does not survive a fork, and makes its worker once.
"""

import concurrent.futures
import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from rich.progress import track

J = TypeVar("J")
R = TypeVar("R")


def cores() -> int:
    """Return the cores that this process may use; macOS does not limit them."""
    limited = hasattr(os, "sched_getaffinity")
    return len(os.sched_getaffinity(0)) if limited else os.cpu_count() or 1


def run(
    make: Callable[..., Callable[[J], R]],
    arguments: tuple[Any, ...],
    jobs: Sequence[J],
    count: int | None = None,
) -> list[R]:
    """Return what a worker, `make(*arguments)`, says to each job, with a progress bar.

    Args:
        make: a class or function of a module, so that another process finds it.
        arguments: can be pickled, as jobs and results can.
        jobs: in the order of the results.
        count: of processes; one a core when left out; with 1 all is done in this one.
    """
    count = min(count or cores(), len(jobs))
    shown = lambda results: list(track(results, "walking", len(jobs), transient=True))
    if count == 1:
        return shown(map(make(*arguments), jobs))
    pool = concurrent.futures.ProcessPoolExecutor(
        count, multiprocessing.get_context("spawn"), _begin, (make, arguments)
    )
    try:
        with _without_interrupts():
            futures = [pool.submit(_work, job) for job in jobs]
        return shown(future.result() for future in futures)
    except BaseException:  # such as Ctrl-C, which does not wait for the others
        for child in multiprocessing.active_children():
            child.kill()
        raise
    finally:
        pool.shutdown()


_worker: Callable[[Any], Any] | None = None  # of this process


def _begin(make: Callable[..., Callable[[Any], Any]], arguments: tuple[Any, ...]) -> None:
    global _worker
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _worker = make(*arguments)


def _end_with_parent() -> None:
    """Wait for the end of the process that made this one: after Ctrl-C nobody else tells it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Keep Ctrl-C from the processes that are made here: each would print a traceback."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(job: Any) -> Any:
    assert _worker is not None
    return _worker(job)
