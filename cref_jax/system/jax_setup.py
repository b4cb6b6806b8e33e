"""Process-wide settings of JAX and XLA, made before JAX is used."""

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterable
from pathlib import Path

import jax

from cref_jax.system import parallel

_MMAP_MAX, _TRIM_THRESHOLD = -4, -1  # parameters of mallopt, malloc.h
_THREADS = 8  # of XLA at least; assumed: twice what two devices' programs may hold at a time


def prepare(engines: Iterable[str] = ()) -> None:
    """Set JAX up for programs with these engines, before it is used for the first time."""
    _use_wide_registers()
    _use_compile_cache()
    _use_every_core()
    if "mjx" in engines:
        _spare_threads()
    _keep_memory()


def _use_wide_registers() -> None:
    """Let XLA use 512 bits where the CPU has them: an update takes an eighth less time."""
    try:
        wide = "avx512f" in Path("/proc/cpuinfo").read_text()
    except OSError:
        wide = False
    if wide:
        _flag("xla_cpu_prefer_vector_width", 512)


def _use_compile_cache() -> None:
    """Keep compiled programs in the user's own cache; it holds code, and so is private."""
    home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    folder = home / "cref_jax" / "xla"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError:
        return  # a read-only home costs time, nothing else
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


def _use_every_core() -> None:
    """Let JAX count the CPU as one device a core, where nobody has said otherwise.

    Robots that are shared out among four cores are trained half as fast again as by operations
    that are each shared out.
    """
    _flag("xla_cpu_collective_call_terminate_timeout_seconds", 10**6)  # it may have to wait long,
    _flag("xla_cpu_collective_call_warn_stuck_timeout_seconds", 600)  # as on a laptop that slept
    chosen = jax.config.jax_num_cpu_devices > 0 or "device_count" in os.environ.get("XLA_FLAGS", "")
    if not chosen:
        with contextlib.suppress(RuntimeError):  # JAX is in use already
            jax.config.update("jax_num_cpu_devices", parallel.cores())


def _spare_threads() -> None:
    """Give XLA threads to spare on a CPU of few cores.

    A batched Cholesky, of which engine `mjx` has many, holds a thread while others do its work; as
    many at once as there are threads wait for ever. Other programs are better off without: with
    eight threads on two cores, training with MuJoCo C makes 0.7 of the samples.
    """
    os.environ.setdefault("NPROC", str(max(parallel.cores(), _THREADS)))


def _keep_memory() -> None:
    """Let glibc keep the buffers of a program for its next call.

    A call needs some hundred MB, and asking the system for them anew takes a tenth of an iteration.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt:
        mallopt(_MMAP_MAX, 0)  # buffers of their own would be given back
        mallopt(_TRIM_THRESHOLD, 2**31 - 1)  # bytes; as much as can be kept


def _flag(name: str, value: int) -> None:
    """Set one of XLA's flags, where nobody has."""
    flags = os.environ.get("XLA_FLAGS", "")
    if name not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --{name}={value}".strip()
