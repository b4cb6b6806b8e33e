"""The lock of a run's folder, so that no second run writes there."""

import contextlib
import fcntl
import logging
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from cref_jax.errors import CheckpointError

LOG = logging.getLogger(__name__)


@contextlib.contextmanager
def lock(directory: str | os.PathLike[str]) -> Iterator[None]:
    """Hold `run.lock` in `directory`, created if missing, so that no second run writes there.

    The kernel frees the lock however its process dies. The pid and host in the file are for the
    message, and for file systems without locks or shared with other hosts.

    Raises:
        CheckpointError: another run holds it, or the directory cannot be written.
    """
    path = Path(directory).absolute() / "run.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a+", encoding="utf-8", errors="replace")
    except OSError as error:
        raise CheckpointError(f"{path.parent}: cannot be written: {error.strerror}") from error
    with file:
        _take_lock(file, path)
        try:
            yield
        finally:
            file.truncate(0)  # not removed: a waiting run may have the file open


def _take_lock(file: TextIO, path: Path) -> None:
    """Lock `file` and write our pid and host into it."""
    locks = True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        held = False
    except BlockingIOError:
        held = True
    except OSError:  # a file system without locks
        locks = held = False
    file.seek(0)
    pid, _, host = file.read(1000).strip().partition(" ")
    dead = host == socket.gethostname() and (locks or not _is_alive(pid))
    if held or (host and not dead):
        raise CheckpointError(
            f"{path.parent}: in use by process {pid} on {host}; if it is dead, remove {path}"
        )
    if host:
        LOG.warning("%s: taken over from process %s, which died", path, pid)
    file.truncate(0)
    file.write(f"{os.getpid()} {socket.gethostname()}\n")
    file.flush()


def _is_alive(pid: str) -> bool:
    """Check whether a process with this pid runs on this host."""
    try:
        os.kill(int(pid), 0)
    except (ProcessLookupError, ValueError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
