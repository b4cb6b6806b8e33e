"""Devices: where a run goes on, how its environments are sharded, and their memory."""

import contextlib
import os
import resource
import sys
from pathlib import Path
from typing import Literal

import jax
from jax.sharding import Mesh

from cref_jax.config import Config
from cref_jax.errors import ConfigError
from cref_jax.system import jax_setup
from cref_jax.terrain import lanes
from cref_jax.training import iteration

Device = Literal["auto", "cpu", "gpu"]
CONTAINER_LIMITS = (  # files of cgroup v2 and v1
    "/sys/fs/cgroup/memory.max",
    "/sys/fs/cgroup/memory/memory.limit_in_bytes",
)


def select_device(device: Device) -> Literal["cpu", "gpu"]:
    """Choose where the program runs, before JAX is used for the first time.

    Raises:
        ConfigError: a GPU is asked for, or its plugin installed, and JAX has none; or JAX has no
            device of JAX_PLATFORMS.
    """
    if device == "cpu":
        jax.config.update("jax_platforms", "cpu")
    is_chosen = jax.config.jax_platforms == "cpu"  # here, or by JAX_PLATFORMS
    try:
        backend = jax.default_backend()
    except (RuntimeError, AssertionError):  # JAX asserts that there is a device
        raise ConfigError(
            f"JAX_PLATFORMS={jax.config.jax_platforms}: JAX has no such device here; unset it, or "
            "see whether the device's driver works and JAX's plugin for it is installed"
        ) from None
    if backend != "gpu" and not is_chosen and jax_setup.has_cuda_plugin():
        raise ConfigError(
            "JAX's CUDA plugin is installed and finds no GPU: see whether nvidia-smi does, and "
            "whether its driver is 525 or newer (cuda12), 580 (cuda13); --device cpu trains without"
        )
    if device == "gpu" and backend != "gpu":
        raise ConfigError(
            "--device gpu: JAX has no GPU here; install its plugin with: "
            "pip install 'cref-jax[cuda12]' (driver 525 or newer) or 'cref-jax[cuda13]' (580)"
        )
    return "cpu" if backend == "cpu" else "gpu"


def choose_mesh(c: Config, requested: int | None = None) -> Mesh:
    """Choose the devices to shard a run's robots over: `requested`, or as many as divide them.

    Each device takes the kinds of lane in turn by itself, so it needs robots for a whole turn.

    Raises:
        ConfigError: there are fewer devices, the robots do not divide evenly, or a process of
            several would have no device.
    """
    available, parts, turn = jax.device_count(), c.ppo.minibatches, lanes.count_turns(c.terrain)
    fits = lambda n: c.run.num_envs % (n * parts) == 0 and (n == 1 or c.run.num_envs >= n * turn)
    even = [n for n in range(1, available + 1) if fits(n)]
    if jax.process_count() > 1:  # each has a part
        requested = requested or available
        if requested != available:
            raise ConfigError(
                f"--devices {requested}: several processes train on all of their {available}"
            )
    if requested is not None and requested not in even:
        each = f", {turn} and more on each for the kinds of lane" if turn > 1 else ""
        raise ConfigError(
            f"--devices {requested}: {c.run.num_envs} robots in {parts} minibatches can be "
            f"sharded over {', '.join(map(str, even))} of the {available} devices here{each}"
        )
    return iteration.make_mesh(requested or even[-1])


def check_memory(program: jax.stages.Compiled, num_envs: int, devices: int = 1) -> int:
    """Compute the bytes that a program needs per device, including its arguments.

    The `devices` of a CPU share one memory: there, the sum over all of them and what the process
    holds already.

    Raises:
        ConfigError: the memory is smaller.
    """
    m = program.memory_analysis()
    if m is None:  # not reported by this device
        return 0
    needed = m.argument_size_in_bytes + m.temp_size_in_bytes
    needed += m.output_size_in_bytes - m.alias_size_in_bytes
    stats = jax.local_devices()[0].memory_stats()  # None on a CPU
    available = stats["bytes_limit"] if stats else main_memory()
    held = 0 if stats else _resident_memory()
    needed *= 1 if stats else devices
    if held + needed > available:
        fits = num_envs * max(available - held, 0) // needed
        needed += held
        raise ConfigError(
            f"{num_envs} robots need {needed / 2**30:.1f} GiB and the device has "
            f"{available / 2**30:.1f}; use --num-envs {2 ** max(fits.bit_length() - 1, 0)}"
        )
    return held + needed


def _resident_memory() -> int:
    """Read the memory that this process holds, bytes; the most so far where Linux is not asked."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most if sys.platform == "darwin" else 1024 * most
    return pages * os.sysconf("SC_PAGE_SIZE")


def main_memory() -> int:
    """Read the memory that this process may use, bytes: the machine's, or its container's."""
    sizes = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for file in CONTAINER_LIMITS:
        with contextlib.suppress(OSError, ValueError):  # no container, or `max`
            sizes.append(int(Path(file).read_text()))
    return min(sizes)
