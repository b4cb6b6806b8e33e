"""Compile the training program for an NVIDIA GPU on a machine without one.

    python -m cref_jax.gpu_program --gpu h100

XLA compiles for a GPU from a description of the card. Nothing is executed and no arrays are
allocated: world and state are shapes. This needs the packages of the CUDA plugin but no driver. The
estimate is a bound from the card's bandwidth, its FLOP rate and the launches, not a measurement.
"""

import cref_jax.system.startup  # noqa: F401

import collections
import dataclasses
import os
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import topologies
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import PyTree
from rich.console import Console
from rich.table import Table

from cref_jax import cli, depth, robot
from cref_jax.benchmarks import hlo, source_stages
from cref_jax.config import Config, limits, presets
from cref_jax.config.ranges import Within
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.physics.records import Backend, Body
from cref_jax.physics.simulation import Physics
from cref_jax.system import jax_setup
from cref_jax.terrain import lanes
from cref_jax.training import iteration

LAUNCH = 3e-6  # s; assumed: least time per kernel, including its launch
BANDWIDTH_SHARE = 0.8  # assumed: achieved share of the card's bandwidth
PRODUCT_SHARE = 0.25  # assumed: achieved share of the card's TF32 rate
MARCH_TURNS = 80  # assumed: blocks crossed by the longest ray of a frame


class Card(NamedTuple):
    """An NVIDIA GPU as XLA describes it; values from its data sheet."""

    name: str
    capability: tuple[int, int]
    multiprocessors: int
    threads: int  # per multiprocessor
    shared: int  # bytes of shared memory per multiprocessor
    shared_block: int  # bytes of shared memory per block, at most
    cache: int  # bytes of L2
    clock: float  # GHz
    memory: int  # bytes
    bandwidth: float  # bytes/s
    products: float  # flop/s in TF32


KIB, MIB, GB, T = 2**10, 2**20, 10**9, 1e12
CARDS = {
    "h100": Card(
        *("NVIDIA H100 80GB HBM3", (9, 0), 132, 2048, 228 * KIB, 227 * KIB),
        *(50 * MIB, 1.98, 80 * GB, 3.35 * T, 495 * T),
    ),
    "a100": Card(
        *("NVIDIA A100-SXM4-80GB", (8, 0), 108, 2048, 164 * KIB, 163 * KIB),
        *(40 * MIB, 1.41, 80 * GB, 2.04 * T, 156 * T),
    ),
    "4090": Card(
        *("NVIDIA GeForce RTX 4090", (8, 9), 128, 1536, 100 * KIB, 99 * KIB),
        *(72 * MIB, 2.52, 24 * GB, 1.01 * T, 82.6 * T),
    ),
}


@dataclass(frozen=True)
class Options(cli.DebugOption):
    """Compile the training program for a GPU without having one, and estimate its time."""

    gpu: Literal["h100", "a100", "4090"] = "h100"
    """GPU to compile for"""
    terrain: str = "mixed"
    """terrain name"""
    robot: str | None = None
    """a robot by name (default: the first)"""
    num_envs: Annotated[int | None, Within(1, 1_000_000)] = None
    """parallel robots (default: as in `make train` on a GPU)"""


class Stage(NamedTuple):
    """Launches, work and time of a part of an iteration."""

    launches: float
    bytes: float
    flops: float  # of matrix products
    seconds: float


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a mistake in it is one line and exit code 2."""
    with cli.one_line_errors(arguments):
        options = cli.parse(Options, arguments, "gpu_program")
        c = robot.fill_in(presets.build_config(options.terrain, None, "gpu"), options.robot)
        if options.num_envs is not None:
            c = dataclasses.replace(c, run=dataclasses.replace(c.run, num_envs=options.num_envs))
        limits.check(c)
        card = CARDS[options.gpu]
        prepare()
        mesh = mesh_of(card)
        with Console().status(f"compiling for {card.name} (five minutes on one core)"):
            compiled = trace_iteration(c, "mjx", mesh).lower().compile()
        stages = estimate_stages(hlo.Program(compiled.as_text()), c, card)
        show(c, card, compiled, stages)


def prepare() -> None:
    """Configure JAX for a plugin without a device.

    Raises:
        ConfigError: the plugin is not installed.
    """
    if not jax_setup.has_cuda_plugin():
        raise ConfigError("compiling for a GPU needs JAX's plugin: pip install 'cref-jax[cuda12]'")
    os.environ.setdefault("XLA_FLAGS", "--xla_gpu_force_compilation_parallelism=1")  # memory
    jax.config.update("jax_platforms", "cpu")  # the plugin compiles without a device
    jax.config.update("jax_traceback_in_locations_limit", -1)  # stages are found by full stacks


def mesh_of(card: Card) -> Mesh:
    """Build a mesh of one device described by `card`."""
    topology = topologies.get_topology_desc(
        card.name, "cuda", target_config=_target_config(card), topology="1x1x1"
    )
    return Mesh(np.array(topology.devices), (iteration.AXIS,), axis_types=(AxisType.Auto,))


def _target_config(card: Card) -> str:
    """Format the card as the text of XLA's GpuTargetConfigProto."""
    major, minor = card.capability
    return f"""
    gpu_device_info {{
      threads_per_block_limit: 1024
      threads_per_warp: 32
      shared_memory_per_block: 49152
      shared_memory_per_core: {card.shared}
      shared_memory_per_block_optin: {card.shared_block}
      threads_per_core_limit: {card.threads}
      core_count: {card.multiprocessors}
      fpus_per_core: 128
      block_dim_limit_x: 2147483647
      block_dim_limit_y: 65535
      block_dim_limit_z: 65535
      registers_per_core_limit: 65536
      registers_per_block_limit: 65536
      memory_bandwidth: {card.bandwidth:.0f}
      l2_cache_size: {card.cache}
      clock_rate_ghz: {card.clock}
      device_memory_size: {card.memory}
      cuda_compute_capability {{ major: {major} minor: {minor} }}
    }}
    runtime_version {{ major: 12 minor: 8 patch: 0 }}
    platform_name: "CUDA"
    dnn_version_info {{ major: 9 minor: 10 }}
    device_description_str: "{card.name}"
    """


def trace_iteration(c: Config, engine: Backend, mesh: Mesh) -> jax.stages.Traced:
    """Trace one training iteration from shapes on the devices of a mesh."""
    world = abstract_world(c, engine, NamedSharding(mesh, P()))
    return iteration.chunk.trace(world, iteration.state_shapes(world, mesh), mesh, 1)


def abstract_world(c: Config, engine: Backend, place: NamedSharding) -> World:
    """Build the world with shapes for arrays, since settling robots would compile their physics.

    Raises:
        ConfigError: the terrain is invalid, or the engine is not installed.
    """
    shape = lambda *sizes: jax.ShapeDtypeStruct(sizes, jnp.float32, sharding=place)
    physics, count = Physics(c.robot, c.physics, engine), c.episode.bank_size
    positions, velocities = physics.model.nq, physics.model.nv
    bank = Body(shape(count, positions), shape(count, velocities), shape(count, velocities))
    return World(robot.fill_in(c), physics, _abstract_arrays(lanes.build(c.terrain), place), bank)


def _abstract_arrays(arrays: PyTree, place: NamedSharding) -> PyTree:
    """Replace arrays by their shapes and dtypes on these devices."""
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x), sharding=place), arrays
    )


def estimate_stages(program: hlo.Program, c: Config, card: Card) -> dict[str, Stage]:
    """Estimate the launches, work and time of each stage of an iteration, longest first."""
    frames = depth.max_frames(c.ppo.horizon, c.camera, c.physics.control_period)

    def trip_count(stack: tuple[hlo.Frame, ...]) -> float:
        if source_stages.is_at(stack, "mjx/_src/solver.py", ""):
            return float(c.physics.iterations)  # the slowest robot needs the maximum
        if source_stages.is_at(stack, "cref_jax/depth/raymarch.py", ""):
            return float(MARCH_TURNS)
        return (
            frames / c.ppo.horizon
            if source_stages.is_at(stack, "cref_jax/training/camera_feed.py", "update_feed")
            else 1.0
        )

    stages = collections.defaultdict(lambda: Stage(0.0, 0.0, 0.0, 0.0))
    for kernel in program.kernels(trip_count):
        name = source_stages.stage_of(kernel.stack)
        name = (
            source_stages.stage_of(kernel.loop) if name == source_stages.REST else name
        )  # a copy of the loop carry
        moved = kernel.bytes / (BANDWIDTH_SHARE * card.bandwidth)
        seconds = max(LAUNCH, moved, kernel.flops / (PRODUCT_SHARE * card.products))
        one = Stage(1.0, kernel.bytes, kernel.flops, seconds)
        stages[name] = Stage(
            *(a + kernel.times * b for a, b in zip(stages[name], one, strict=True))
        )
    return dict(sorted(stages.items(), key=lambda item: -item[1].seconds))


def show(c: Config, card: Card, compiled: jax.stages.Compiled, stages: dict[str, Stage]) -> None:
    """Print the stages and the memory of an iteration."""
    samples = c.run.num_envs * c.ppo.horizon
    table = Table(title=f"{c.terrain.name}, {c.run.num_envs} robots x {c.ppo.horizon}, {card.name}")
    for column in ("stage", "launches", "GB", "Tflop", "ms, estimated"):
        table.add_column(column, justify="left" if column == "stage" else "right")
    total = Stage(*(sum(column) for column in zip(*stages.values(), strict=True)))
    for name, s in [*stages.items(), ("iteration", total)]:
        work = f"{s.launches:,.0f}", f"{s.bytes / 1e9:,.1f}", f"{s.flops / 1e12:,.2f}"
        table.add_row(name, *work, f"{1e3 * s.seconds:,.1f}")
    cli.print_table(table)
    console = Console()
    if memory := compiled.memory_analysis():
        gib = memory.argument_size_in_bytes / 2**30, memory.temp_size_in_bytes / 2**30
        console.print(f"memory: {gib[0]:.2f} GiB of state, {gib[1]:.2f} GiB temporary")
    console.print(f"estimate, nothing was run: {samples / total.seconds:,.0f} samples/s at most")


if __name__ == "__main__":
    main()
