"""Checkpoints of the whole state of a run: orbax for the arrays, JSON for their origin.

A step is one directory, complete or absent. This module closes gaps in orbax, which detects neither
a flipped bit nor a changed dtype: every leaf carries its SHA-256. Orbax's manager silently skips a
save if a directory has a higher number, and deletes directories that it did not write: steps are
listed and pruned here.
"""

import contextlib
import hashlib
import importlib.metadata
import json
import logging
import os
import platform
import re
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import orbax.checkpoint as ocp
from jaxtyping import PyTree

from cref_jax.errors import CheckpointError, DamagedCheckpoint
from cref_jax.training import processes, pytree_digest

LOG = logging.getLogger(__name__)
SCHEMA = 1  # to be incremented when an older program would misread a new step
PACKAGES = ("cref-jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "numpy")
LEFTOVER = re.compile(r"\d+\.(new|old)(\.orbax-checkpoint-tmp.*)?")


class Loaded(NamedTuple):
    """The contents of one step."""

    step: int
    arrays: dict[str, Any]  # by path in the state
    record: dict[str, Any]


class Checkpoints:
    """The steps of one run; the newest `keep` are kept. Reading changes nothing on disk."""

    def __init__(self, directory: str | os.PathLike[str], keep: int = 3) -> None:
        self.directory = Path(directory).absolute()  # as orbax requires
        self.keep = keep
        self._current_step = -1  # last written or restored by this run
        self._foreign: set[Path] = set()  # numbered directories already warned about
        self._orbax = _open_orbax()

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop orbax's threads."""
        self._orbax.close()

    def steps(self) -> list[int]:
        """List the steps on disk, oldest first. Other numbered directories get a warning."""
        steps = []
        for path in self.directory.glob("*"):
            if not re.fullmatch(r"0|[1-9][0-9]*", path.name):
                continue
            if (path / "state").is_dir() or (path / "meta").is_dir():
                steps.append(int(path.name))
            elif path not in self._foreign:
                self._foreign.add(path)
                LOG.warning("%s is not a checkpoint; skipped", path)
        return sorted(steps)

    def latest(self) -> int | None:
        """Return the newest step on disk, or None."""
        return max(self.steps(), default=None)

    def save(self, iteration: int, carry: PyTree, meta: dict[str, Any]) -> None:
        """Write `carry` and `meta` (JSON); on return the step is complete on disk.

        A run's current step is the one it wrote or restored last. Newer ones belong to an abandoned
        future: they are renamed to `<step>.aside-<time>`, never deleted.

        Raises:
            CheckpointError: writing failed, or the directory contains the steps of another run.
        """
        host = pytree_digest.on_host(carry)
        if not processes.is_first():
            self._current_step = iteration
            return
        index = pytree_digest.describe(carry, host)
        if iteration == self._current_step and self._holds(iteration, index):
            return
        own = {"schema": SCHEMA, "iteration": iteration, "versions": _package_versions()}
        record = json.loads(
            json.dumps({**meta, **own, "devices": _describe_devices(), "leaves": index})
        )
        try:
            self._write(iteration, host, record)
        except CheckpointError:
            raise
        except Exception as error:  # orbax and TensorStore raise many kinds
            step = self.directory / str(iteration)
            raise CheckpointError(f"{step}: could not be written: {_first_line(error)}") from error

    def meta(self, step: int | None = None) -> dict[str, Any]:
        """Read the `meta` of a step, with its iteration, schema, versions and devices."""
        return _without_leaves(self._record(self._candidates(step)[0]))

    def restore(
        self,
        like: PyTree,
        step: int | None = None,
        parts: Sequence[str] | None = None,
        allow_fallback: bool = False,
    ) -> tuple[PyTree, dict[str, Any]]:
        """Load the stored state and its meta; this becomes the run's current step.

        Args:
            like: a fresh state of the same structure, shapes and dtypes; its shardings are used.
            step: the newest one if None.
            parts: top-level names of the state, such as ("params", "optimiser"). Only these are
                read; the rest of `like` is returned unchanged, to continue with another number of
                environments.
            allow_fallback: log a damaged step and try the one before it.

        Raises:
            DamagedCheckpoint: the files differ from those written.
            CheckpointError: no step, a newer schema, or a leaf of another shape or dtype.
        """
        every = pytree_digest.by_path(like)
        unknown = [part for part in parts or () if not any(_is_within(p, [part]) for p in every)]
        if unknown:
            raise CheckpointError(f"the state has no part '{unknown[0]}'")
        wanted = {path: leaf for path, leaf in every.items() if _is_within(path, parts)}
        loaded = self._load(wanted, parts, step, allow_fallback)
        self._current_step = loaded.step
        self._warn_if_moved(loaded)
        return pytree_digest.fill_from(like, loaded.arrays), _without_leaves(loaded.record)

    def restore_part(
        self, name: str, like: PyTree, step: int | None = None, allow_fallback: bool = False
    ) -> PyTree:
        """Load one part of the stored state, such as "params".

        `like` has the structure of the part; the result of `jax.eval_shape` is enough.
        """
        loaded = self._load(pytree_digest.by_path(like, name), (name,), step, allow_fallback)
        return pytree_digest.fill_from(like, loaded.arrays, name)

    def _write(self, iteration: int, host: dict[str, np.ndarray], record: dict[str, Any]) -> None:
        """Write to a temporary directory, then rename it: a kill loses at most one save."""
        self.directory.mkdir(parents=True, exist_ok=True)
        self._sweep()
        newest = self.latest()
        if self._current_step < 0 and newest is not None:
            raise CheckpointError(
                f"{self.directory}: contains step {newest} of another run; resume that run "
                "or choose another directory"
            )
        staged, final = (self.directory / f"{iteration}{suffix}" for suffix in (".new", ""))
        content = ocp.args.Composite(
            state=ocp.args.PyTreeSave({p: x for p, x in host.items() if x.size}),  # refuses size 0
            meta=ocp.args.JsonSave({"sha256": _record_digest(record), "record": record}),
        )
        self._orbax.save(staged, content)
        for step in self.steps():
            if step > self._current_step or step == iteration:
                _set_aside(self.directory / str(step))
        if final.exists():  # not a checkpoint
            _set_aside(final)
        staged.rename(final)
        self._current_step = iteration
        for step in self.steps()[: -self.keep]:
            old = self.directory / f"{step}.old"
            (self.directory / str(step)).rename(old)
            shutil.rmtree(old)

    def _sweep(self) -> None:
        """Remove the leftovers of an interrupted save or removal."""
        for path in self.directory.glob("*"):
            if LEFTOVER.fullmatch(path.name):
                shutil.rmtree(path, ignore_errors=True)

    def _holds(self, step: int, index: dict[str, Any]) -> bool:
        """Check whether `step` already contains the state that `index` describes."""
        try:
            return self._record(step)["leaves"] == index
        except CheckpointError:
            return False

    def _candidates(self, step: int | None) -> list[int]:
        """List the steps to try, newest first."""
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
        """Load the `wanted` leaves of `step`, or of the first older step that is intact."""
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
        """Read the record stored with the arrays of `step` and check its digest."""
        path = self.directory / str(step)
        try:
            sealed = self._orbax.restore(path, ocp.args.Composite(meta=ocp.args.JsonRestore())).meta
            seal, record = sealed["sha256"], sealed["record"]
            schema = int(record["schema"])
        except Exception as error:
            raise DamagedCheckpoint(
                f"{path}: the record is damaged: {_first_line(error)}"
            ) from error
        if seal != _record_digest(record):
            raise DamagedCheckpoint(f"{path}: the record is damaged: its digest differs")
        if schema > SCHEMA:
            raise CheckpointError(
                f"{path}: written by a newer program (schema {schema}, this one reads {SCHEMA})"
            )
        return record

    def _read(self, step: int, wanted: dict[str, Any], parts: Sequence[str] | None) -> Loaded:
        """Read the `wanted` leaves of `step`, check their digests and put them on their devices."""
        path = self.directory / str(step)
        record = self._record(step)
        index = {key: leaf for key, leaf in record["leaves"].items() if _is_within(key, parts)}
        _check_leaves(path, wanted, index)
        empty = {
            key: pytree_digest.empty_like(like) for key, like in wanted.items() if 0 in like.shape
        }
        stored = {key: 0 for key in wanted if key not in empty}
        request = ocp.args.PyTreeRestore(
            item=stored,
            restore_args={key: ocp.RestoreArgs(restore_type=np.ndarray) for key in stored},
            partial_restore=True,
        )
        try:
            restored = self._orbax.restore(path, ocp.args.Composite(state=request)).state
        except Exception as error:  # orbax and TensorStore raise many kinds
            raise DamagedCheckpoint(f"{path}: damaged: {_first_line(error)}") from error
        host = {key: np.asarray({**restored, **empty}.get(key)) for key in index}
        for key, leaf in index.items():
            if pytree_digest.bits_digest(host[key]) != leaf["sha256"]:
                raise DamagedCheckpoint(f"{path}: damaged: the digest of {key} differs")
        arrays = {
            key: pytree_digest.put_like(host[key], like, index[key]["impl"])
            for key, like in wanted.items()
        }
        return Loaded(step, arrays, record)

    def _warn_if_moved(self, loaded: Loaded) -> None:
        """Warn of changes since the save: the run continues, but not bit for bit."""
        stored = {**loaded.record["versions"], "devices": loaded.record["devices"]}
        here = {**_package_versions(), "devices": _describe_devices()}
        changed = [name for name in here if stored.get(name) != here[name]]
        changes = ", ".join(f"{name} {stored.get(name)} -> {here[name]}" for name in changed)
        if changes:
            step = self.directory / str(loaded.step)
            LOG.warning("%s: continues, but not bit for bit: %s", step, changes)


def _is_within(path: str, parts: Sequence[str] | None) -> bool:
    """Check whether `path` lies in one of `parts`; None means everything."""
    return parts is None or any(path == part or path.startswith(f"{part}/") for part in parts)


def _check_leaves(path: Path, wanted: dict[str, Any], index: dict[str, Any]) -> None:
    """Check that the stored leaves match those wanted; report the first difference."""
    text = lambda shape, dtype: f"{dtype}{list(shape)}"
    here = {key: text(leaf.shape, leaf.dtype) for key, leaf in wanted.items()}
    stored = {key: text(leaf["shape"], leaf["dtype"]) for key, leaf in index.items()}
    differing = [key for key in here | stored if here.get(key) != stored.get(key)]
    if differing:
        key, *others = differing
        sides = f"{stored.get(key, 'absent')} on disk, {here.get(key, 'absent')} here"
        more = f" (and {len(others)} more)" if others else ""
        raise CheckpointError(f"{path}: {key} is {sides}{more}")


def _record_digest(record: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def _without_leaves(record: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in record.items() if key != "leaves"}


def _set_aside(path: Path) -> None:
    aside = path.with_name(f"{path.name}.aside-{time.time_ns()}")
    path.rename(aside)
    LOG.warning("%s set aside as %s", path, aside.name)


def _open_orbax() -> ocp.Checkpointer:
    """Open orbax so that it waits for no other process: each reads by itself, and one writes."""
    number = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=number, active_processes={number}, barrier_sync_key_prefix=f"{number}"
    )
    options = ocp.CompositeOptions(multiprocessing_options=alone)
    handler = ocp.CompositeCheckpointHandler(composite_options=options)
    return ocp.Checkpointer(handler, multiprocessing_options=alone)


def _package_versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


def _describe_devices() -> str:
    return f"{jax.device_count()} x {jax.devices()[0].device_kind}"


def _first_line(error: BaseException) -> str:
    """Shorten `error` to one line for a terminal: its type and the start of its message."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:160]}" if lines else type(error).__name__
