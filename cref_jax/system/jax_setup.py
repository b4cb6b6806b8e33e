"""Process-wide settings of JAX and XLA, to be made before JAX is used."""

import contextlib
import ctypes
import importlib.util
import os
import sys
from collections.abc import Iterable
from pathlib import Path

import jax

from cref_jax.system import parallel

_MMAP_MAX, _TRIM_THRESHOLD = -4, -1  # parameters of mallopt, malloc.h
_THREADS = 8  # minimum for XLA; assumed: twice what the programs of two devices hold at once


def prepare(engines: Iterable[str] = ()) -> None:
    """Configure JAX for programs with these engines, before its first use."""
    _use_wide_registers()
    _use_compile_cache()
    _use_every_core()
    if "mjx" in engines:
        _spare_threads()
    _keep_memory()


def has_cuda_plugin() -> bool:
    """Check whether JAX's plugin for NVIDIA's GPUs is installed, with or without a driver."""
    return any(importlib.util.find_spec(f"jax_cuda{n}_plugin") for n in (12, 13))


def _use_wide_registers() -> None:
    """Let XLA use 512-bit vectors if the CPU has them: an update takes an eighth less time."""
    try:
        wide = "avx512f" in Path("/proc/cpuinfo").read_text()
    except OSError:
        wide = False
    if wide:
        _flag("xla_cpu_prefer_vector_width", 512)


def _use_compile_cache() -> None:
    """Cache compiled programs in the user's cache folder, private because it holds code."""
    if jax.config.jax_compilation_cache_dir is None:
        try:
            home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
            folder = Path(home) / "cref_jax" / "xla"
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        except (OSError, RuntimeError):
            return  # a read-only home, or a user without one, only costs compile time
        jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


def _use_every_core() -> None:
    """Expose each CPU core as a JAX device unless the user chose otherwise.

    On four cores, environments sharded over the cores train 1.5 times as fast as operations that
    are each split over them.
    """
    # a collective may wait long, as on a laptop that slept
    _flag("xla_cpu_collective_call_terminate_timeout_seconds", 10**6)
    _flag("xla_cpu_collective_call_warn_stuck_timeout_seconds", 600)
    chosen = jax.config.jax_num_cpu_devices > 0 or "device_count" in os.environ.get("XLA_FLAGS", "")
    if not chosen:
        with contextlib.suppress(RuntimeError):  # JAX is already in use
            jax.config.update("jax_num_cpu_devices", parallel.cores())


def _spare_threads() -> None:
    """Give XLA spare threads on a CPU with few cores.

    A batched Cholesky, of which engine `mjx` runs many, holds a thread while others do its work; if
    they hold all threads at once, they deadlock. Other programs lose by it: with eight threads on
    two cores, training with MuJoCo C collects 0.7 times the samples.
    """
    os.environ.setdefault("NPROC", str(max(parallel.cores(), _THREADS)))


def _keep_memory() -> None:
    """Make glibc keep a program's buffers for its next call.

    A call needs about 100 MB; allocating them anew takes a tenth of an iteration.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt:
        mallopt(_MMAP_MAX, 0)  # mapped buffers would be returned to the system
        mallopt(_TRIM_THRESHOLD, 2**31 - 1)  # bytes, the maximum


def _flag(name: str, value: int) -> None:
    """Set an XLA flag unless it is already set."""
    flags = os.environ.get("XLA_FLAGS", "")
    if name not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --{name}={value}".strip()
