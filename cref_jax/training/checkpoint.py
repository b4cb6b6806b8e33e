"""The whole state of a run on disk: orbax for the arrays, JSON for where they come from.

A step is one directory, complete or absent. What orbax leaves open is closed here. It notices
neither a flipped bit nor a changed dtype, so every leaf carries its SHA-256. Its manager skips a
save without a word while a directory has a higher number, and deletes directories that it did not
write, so steps are listed and pruned here.
"""

import contextlib
import fcntl
import hashlib
import importlib.metadata
import json
import logging
import os
import platform
import re
import shutil
import socket
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import jax
import numpy as np
import orbax.checkpoint as ocp
from jaxtyping import PyTree

from cref_jax.errors import CheckpointError, DamagedCheckpoint
from cref_jax.training import pytree_digest

LOG = logging.getLogger(__name__)
SCHEMA = 1  # one more whenever this program would misread a step of the next one
PACKAGES = ("cref-jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "numpy")
LEFTOVER = re.compile(r"\d+\.(new|old)(\.orbax-checkpoint-tmp.*)?")


class Loaded(NamedTuple):
    """What was read of one step."""

    step: int
    arrays: dict[str, Any]  # by path in the state
    record: dict[str, Any]


class Checkpoints:
    """The steps of one run, of which the newest `keep` stay. Reading changes nothing on disk."""

    def __init__(self, directory: str | os.PathLike[str], keep: int = 3) -> None:
        self.directory = Path(directory).absolute()  # orbax takes no other
        self.keep = keep
        self._stands_on = -1  # the step that this run wrote or restored last
        self._foreign: set[Path] = set()  # warned about
        self._orbax = ocp.Checkpointer(ocp.CompositeCheckpointHandler())

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of orbax's threads."""
        self._orbax.close()

    def steps(self) -> list[int]:
        """Return the steps on disk, oldest first. Numbered directories of others get a warning."""
        found = []
        for path in self.directory.glob("*"):
            if not re.fullmatch(r"0|[1-9][0-9]*", path.name):
                continue
            if (path / "state").is_dir() or (path / "meta").is_dir():
                found.append(int(path.name))
            elif path not in self._foreign:
                self._foreign.add(path)
                LOG.warning("%s is no checkpoint; skipped", path)
        return sorted(found)

    def latest(self) -> int | None:
        """Return the newest step on disk, or None."""
        return max(self.steps(), default=None)

    def save(self, iteration: int, carry: PyTree, meta: dict[str, Any]) -> None:
        """Write `carry` and `meta` (JSON); on return the step is complete on disk.

        A run stands on the step that it wrote or restored last. Newer ones belong to a future that
        it has left: they are renamed to `<step>.aside-<time>`, never deleted.

        Raises:
            CheckpointError: the disk refused, or the directory holds the steps of another run.
        """
        host = pytree_digest.on_host(carry)
        index = pytree_digest.describe(carry, host)
        if iteration == self._stands_on and self._holds(iteration, index):
            return
        own = {"schema": SCHEMA, "iteration": iteration, "versions": _versions()}
        record = json.loads(json.dumps({**meta, **own, "devices": _devices(), "leaves": index}))
        try:
            self._write(iteration, host, record)
        except CheckpointError:
            raise
        except Exception as error:  # orbax and TensorStore raise many kinds
            step = self.directory / str(iteration)
            raise CheckpointError(f"{step}: could not be written: {_line(error)}") from error

    def meta(self, step: int | None = None) -> dict[str, Any]:
        """Return the `meta` of a step together with its iteration, schema, versions and devices."""
        return _public(self._record(self._candidates(step)[0]))

    def restore(
        self,
        like: PyTree,
        step: int | None = None,
        parts: Sequence[str] | None = None,
        allow_fallback: bool = False,
    ) -> tuple[PyTree, dict[str, Any]]:
        """Return the stored state and its meta; the run then stands on this step.

        Args:
            like: a fresh state of the same structure, shapes and dtypes; its shardings are used.
            step: the newest one when None.
            parts: names at the top of the state, such as ("params", "optimiser"). Only these are
                read and the rest of `like` comes back as it is: the way to go on with another
                number of environments.
            allow_fallback: log a damaged step and try the one before it.

        Raises:
            DamagedCheckpoint: the files are not what was written.
            CheckpointError: no step, a newer schema, or a leaf of another shape or dtype.
        """
        every = pytree_digest.by_path(like)
        unknown = [part for part in parts or () if not any(_within(p, [part]) for p in every)]
        if unknown:
            raise CheckpointError(f"the state has no part '{unknown[0]}'")
        wanted = {path: leaf for path, leaf in every.items() if _within(path, parts)}
        loaded = self._load(wanted, parts, step, allow_fallback)
        self._stands_on = loaded.step
        self._warn_if_moved(loaded)
        return pytree_digest.fill_from(like, loaded.arrays), _public(loaded.record)

    def restore_part(
        self, name: str, like: PyTree, step: int | None = None, allow_fallback: bool = False
    ) -> PyTree:
        """Return one part of the stored state, "params" say, for a reader that needs no more.

        `like` has the structure of the part; what `jax.eval_shape` returns will do.
        """
        loaded = self._load(pytree_digest.by_path(like, name), (name,), step, allow_fallback)
        return pytree_digest.fill_from(like, loaded.arrays, name)

    def _write(self, iteration: int, host: dict[str, np.ndarray], record: dict[str, Any]) -> None:
        """Write beside the other steps, then rename: a kill at any time costs one save at most."""
        self.directory.mkdir(parents=True, exist_ok=True)
        self._sweep()
        newest = self.latest()
        if self._stands_on < 0 and newest is not None:
            raise CheckpointError(
                f"{self.directory}: holds step {newest} of another run; resume it or go elsewhere"
            )
        staged, final = (self.directory / f"{iteration}{suffix}" for suffix in (".new", ""))
        content = ocp.args.Composite(
            state=ocp.args.PyTreeSave({p: x for p, x in host.items() if x.size}),  # refuses size 0
            meta=ocp.args.JsonSave({"sha256": _seal(record), "record": record}),
        )
        self._orbax.save(staged, content)
        for step in self.steps():
            if step > self._stands_on or step == iteration:
                _set_aside(self.directory / str(step))
        if final.exists():  # of someone else
            _set_aside(final)
        staged.rename(final)
        self._stands_on = iteration
        for step in self.steps()[: -self.keep]:
            old = self.directory / f"{step}.old"
            (self.directory / str(step)).rename(old)
            shutil.rmtree(old)

    def _sweep(self) -> None:
        """Remove what an interrupted save or removal has left."""
        for path in self.directory.glob("*"):
            if LEFTOVER.fullmatch(path.name):
                shutil.rmtree(path, ignore_errors=True)

    def _holds(self, step: int, index: dict[str, Any]) -> bool:
        """Say whether `step` already holds the state that `index` describes."""
        try:
            return self._record(step)["leaves"] == index
        except CheckpointError:
            return False

    def _candidates(self, step: int | None) -> list[int]:
        """Return the steps to try, best first."""
        steps = [known for known in reversed(self.steps()) if step is None or known <= step]
        if not steps:
            raise CheckpointError(f"{self.directory}: no checkpoint")
        if step is not None and steps[0] != step:
            raise CheckpointError(f"{self.directory}: no checkpoint of step {step}")
        return steps

    def _load(
        self,
        wanted: dict[str, Any],
        parts: Sequence[str] | None,
        step: int | None,
        allow_fallback: bool,
    ) -> Loaded:
        """Return the `wanted` leaves of `step`, or of the first older one that reads well."""
        candidates = self._candidates(step)
        for older in [*candidates[1:], None]:
            try:
                return self._read(candidates[0], wanted, parts)
            except DamagedCheckpoint as error:
                if older is None or not allow_fallback:
                    raise
                LOG.warning("%s; falling back to step %d", error, older)
                candidates = candidates[1:]
        raise AssertionError("the last candidate returns or raises")

    def _record(self, step: int) -> dict[str, Any]:
        """Return what was written beside the arrays of `step`, its own digest checked."""
        path = self.directory / str(step)
        try:
            sealed = self._orbax.restore(path, ocp.args.Composite(meta=ocp.args.JsonRestore())).meta
            seal, record = sealed["sha256"], sealed["record"]
            schema = int(record["schema"])
        except Exception as error:
            raise DamagedCheckpoint(f"{path}: the record is damaged: {_line(error)}") from error
        if seal != _seal(record):
            raise DamagedCheckpoint(f"{path}: the record is damaged: its digest differs")
        if schema > SCHEMA:
            raise CheckpointError(
                f"{path}: written by a newer program (schema {schema}, this one knows {SCHEMA})"
            )
        return record

    def _read(self, step: int, wanted: dict[str, Any], parts: Sequence[str] | None) -> Loaded:
        """Return the `wanted` leaves of `step`, each of the right bits, on the right device."""
        path = self.directory / str(step)
        record = self._record(step)
        index = {key: leaf for key, leaf in record["leaves"].items() if _within(key, parts)}
        _compare(path, wanted, index)
        empty = {key: pytree_digest.empty(like) for key, like in wanted.items() if 0 in like.shape}
        stored = {key: 0 for key in wanted if key not in empty}
        request = ocp.args.PyTreeRestore(
            item=stored,
            restore_args={key: ocp.RestoreArgs(restore_type=np.ndarray) for key in stored},
            partial_restore=True,
        )
        try:
            found = self._orbax.restore(path, ocp.args.Composite(state=request)).state
        except Exception as error:  # orbax and TensorStore raise many kinds
            raise DamagedCheckpoint(f"{path}: damaged: {_line(error)}") from error
        host = {key: np.asarray({**found, **empty}.get(key)) for key in index}
        for key, leaf in index.items():
            if pytree_digest.bits_digest(host[key]) != leaf["sha256"]:
                raise DamagedCheckpoint(f"{path}: damaged: the digest of {key} differs")
        arrays = {
            key: pytree_digest.put_like(host[key], like, index[key]["impl"])
            for key, like in wanted.items()
        }
        return Loaded(step, arrays, record)

    def _warn_if_moved(self, loaded: Loaded) -> None:
        """Say what has changed since the save, because the run goes on, but not bit for bit."""
        there = {**loaded.record["versions"], "devices": loaded.record["devices"]}
        here = {**_versions(), "devices": _devices()}
        changed = [name for name in here if there.get(name) != here[name]]
        moved = ", ".join(f"{name} {there.get(name)} -> {here[name]}" for name in changed)
        if moved:
            step = self.directory / str(loaded.step)
            LOG.warning("%s: goes on, but not bit for bit: %s", step, moved)


@contextlib.contextmanager
def lock(directory: str | os.PathLike[str]) -> Iterator[None]:
    """Hold `run.lock` in `directory`, made if missing, so that no second run writes there.

    The kernel frees the lock when its process dies, however it dies. The pid and the host in the
    file serve the message, and file systems that have no locks or that other hosts write to.

    Raises:
        CheckpointError: another run holds it, or the directory cannot be written.
    """
    path = Path(directory).absolute() / "run.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a+", encoding="utf-8")
    except OSError as error:
        raise CheckpointError(f"{path.parent}: cannot be written: {_line(error)}") from error
    with file:
        _take(file, path)
        try:
            yield
        finally:
            file.truncate(0)  # not removed: a waiting run may have the file open


def _take(file: TextIO, path: Path) -> None:
    """Lock `file` and write our name into it."""
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
    dead = host == socket.gethostname() and (locks or not _alive(pid))
    if held or (host and not dead):
        raise CheckpointError(
            f"{path.parent}: in use by process {pid} on {host}; if that is dead, remove {path}"
        )
    if host:
        LOG.warning("%s: taken over from process %s, which died", path, pid)
    file.truncate(0)
    file.write(f"{os.getpid()} {socket.gethostname()}\n")
    file.flush()


def _alive(pid: str) -> bool:
    """Say whether a process of this host has the number `pid`."""
    try:
        os.kill(int(pid), 0)
    except (ProcessLookupError, ValueError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def _within(path: str, parts: Sequence[str] | None) -> bool:
    """Say whether `path` lies in one of `parts`; None stands for all there is."""
    return parts is None or any(path == part or path.startswith(f"{part}/") for part in parts)


def _compare(path: Path, wanted: dict[str, Any], index: dict[str, Any]) -> None:
    """Raise if the stored leaves are not those wanted, with the first difference."""
    text = lambda shape, dtype: f"{dtype}{list(shape)}"
    here = {key: text(leaf.shape, leaf.dtype) for key, leaf in wanted.items()}
    there = {key: text(leaf["shape"], leaf["dtype"]) for key, leaf in index.items()}
    differing = [key for key in here | there if here.get(key) != there.get(key)]
    if differing:
        key, *others = differing
        sides = f"{there.get(key, 'absent')} there, {here.get(key, 'absent')} here"
        more = f" (and {len(others)} more)" if others else ""
        raise CheckpointError(f"{path}: {key} is {sides}{more}")


def _seal(record: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def _public(record: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in record.items() if key != "leaves"}


def _set_aside(path: Path) -> None:
    aside = path.with_name(f"{path.name}.aside-{time.time_ns()}")
    path.rename(aside)
    LOG.warning("%s set aside as %s", path, aside.name)


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


def _devices() -> str:
    return f"{jax.device_count()} x {jax.devices()[0].device_kind}"


def _line(error: BaseException) -> str:
    """Return the first line of what `error` says, short enough for a terminal."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:160]}" if lines else type(error).__name__
