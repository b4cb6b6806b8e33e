"""What every test runs under: the CPU, no display, and a cache of compiled code."""

import collections
import os
import sys
import tempfile
from ctypes.util import find_library
from pathlib import Path

# Before the first import of jax or mujoco: both read these once.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OMP_NUM_THREADS", "1")  # as a deployed policy wants it
# XLA's threads: a Cholesky of MJX's holds one while others do its work, and two of them would wait
# for ever on two threads
os.environ.setdefault("NPROC", "8")
# Most of the suite's time is compilation; XLA's older emitters take less than half as long.
os.environ.setdefault(
    "XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
)
if sys.platform == "linux" and not os.environ.get("DISPLAY") and find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")

import jax
import pytest


def pytest_configure(config: pytest.Config) -> None:
    jax.config.update("jax_num_cpu_devices", 2)  # what is shared among devices, is among these
    # The cache is the user's own: it holds machine code.
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        cache = Path(home) / "cref_jax" / "tests"
        cache.mkdir(parents=True, exist_ok=True, mode=0o700)
    except (OSError, RuntimeError):
        cache = Path(tempfile.mkdtemp(prefix="cref_jax-"))
    jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files of the most slow tests: so no worker is left with one at the end."""
    slow = collections.Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


# The package is imported inside of these: jaxtyping checks what is imported after it is set up.


@pytest.fixture
def world():
    """Return lanes of every kind, made once."""
    import small_world

    return small_world.world()


@pytest.fixture
def fresh_states():
    """Return 512 robots at their start."""
    import small_world

    return small_world.fresh_states()


@pytest.fixture
def robots():
    """Return eight robots at their start."""
    import small_world

    return small_world.robots()


@pytest.fixture(autouse=True)
def _forget_programs():
    """Drop compiled programs in time: Linux aborts a process of more than 65,530 mappings.

    A test adds 18,000 at most, that of a resumed run of the full network.
    """
    yield
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_bytes().count(b"\n") > 30_000:
        jax.clear_caches()
