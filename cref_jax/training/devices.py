"""The devices that share the environments, and the memory they have."""

import os

import jax
from jax.sharding import Mesh

from cref_jax.config import Config
from cref_jax.errors import ConfigError
from cref_jax.training import iteration


def mesh_of(c: Config, asked: int | None = None) -> Mesh:
    """Return the devices that share a run's robots: as many as `asked`, or as are of use.

    Raises:
        ConfigError: so many are not there, or the robots cannot be shared out among them.
    """
    there, parts = jax.device_count(), c.ppo.minibatches
    even = [n for n in range(1, there + 1) if c.run.num_envs % (n * parts) == 0]
    if asked is not None and asked not in even:
        raise ConfigError(
            f"--devices {asked}: {c.run.num_envs} robots in {parts} minibatches can be shared "
            f"among {', '.join(map(str, even))} of the {there} devices here"
        )
    return iteration.mesh_of(asked or even[-1])


def check_memory(program: jax.stages.Compiled, num_envs: int, devices: int = 1) -> int:
    """Return the bytes that a program takes on a device while it runs, its arguments included.

    Of a CPU, all `devices` have one memory.

    Raises:
        ConfigError: there is less.
    """
    m = program.memory_analysis()
    if m is None:  # a device that does not tell
        return 0
    needed = m.argument_size_in_bytes + m.temp_size_in_bytes
    needed += m.output_size_in_bytes - m.alias_size_in_bytes
    stats = jax.devices()[0].memory_stats()  # a CPU has none
    there = stats["bytes_limit"] if stats else _main_memory()
    needed *= 1 if stats else devices
    if needed > there:
        fits = num_envs * there // needed
        raise ConfigError(
            f"{num_envs} robots need {needed / 2**30:.1f} GiB and the device has "
            f"{there / 2**30:.1f}; take --num-envs {2 ** max(fits.bit_length() - 1, 0)}"
        )
    return needed


def _main_memory() -> int:
    """Return the machine's memory, bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
