"""The plan: which variants are trained with which seeds, on what, and for how long.

FOLDER/plan.json                        it, so that the same command goes on, another is refused
FOLDER/VARIANT-seedN/                   a row of it: the run, as `train` writes it
FOLDER/VARIANT-seedN/evaluation/SUITE/  its evaluations, as `eval` writes them
"""

import dataclasses
import json
import math
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import tyro

from cref_jax import robot
from cref_jax.config import Config, limits, presets
from cref_jax.errors import ConfigError
from cref_jax.evaluation import intervals
from cref_jax.policy import trained
from cref_jax.system import jax_setup
from cref_jax.training import distillation

Experiment = Literal[
    "full", "no_cross_attention", "no_grf", "no_highway", "hpl", "blind", "foot_contact_quality",
    "no_foothold_reward",
]  # fmt: skip
EXPERIMENTS: tuple[Experiment, ...] = typing.get_args(Experiment)
MOST_NAMED = 3  # differences between two plans in one line
FILE = "plan.json"


class Row(NamedTuple):
    """One training of the plan, with its evaluation."""

    variant: str
    seed: int

    @property
    def name(self) -> str:
        """The name of its folder."""
        return f"{self.variant}-seed{self.seed}"


class Plan(NamedTuple):
    """Everything that decides the results."""

    variants: tuple[str, ...]
    seeds: tuple[int, ...]
    terrain: str
    device: str  # cpu or gpu, which have presets of their own
    trials: int  # per cell
    settings: tuple[str, ...]  # options of `train` that are settings of all rows alike
    engine: str  # of the trainings
    devices: int | None  # per training; None: all
    configs: dict[str, Config]  # of each variant, with seed 0

    @property
    def rows(self) -> list[Row]:
        """The rows in the order of training: a whole table with the first seed comes first."""
        return [Row(variant, seed) for seed in self.seeds for variant in self.variants]

    def samples(self, row: Row) -> int:
        """Count the control steps of experience that a row is trained for."""
        c = self.configs[row.variant]
        return trained.count_samples(c, c.run.iterations)


def build(
    variants: Sequence[str],
    seeds: Sequence[int],
    terrain: str,
    device: str,
    trials: int,
    samples: float | None = None,
    num_envs: int | None = None,
    settings: Sequence[str] = (),
    engine: str = "auto",
    devices: int | None = None,
) -> Plan:
    """Build a plan; without `samples` and `num_envs` they are those of the device's preset.

    Raises:
        ConfigError: nothing to train, a variant or a seed named twice, or settings that cannot run.
    """
    for option, values in {"--variants": variants, "--seeds": seeds}.items():
        if not values or len(set(values)) < len(values):
            raise ConfigError(f"{option} must name one or more, each once")
    if len(seeds) > intervals.MOST_VALUES:
        raise ConfigError(f"--seeds must be at most {intervals.MOST_VALUES}, not {len(seeds)}")
    configs = {}
    for variant in variants:
        c = presets.build_config(terrain, variant, device)
        if settings:
            own = c.network.variant
            c = tyro.cli(Config, args=list(settings), default=c, prog="--settings")
            if c.network.variant != own:
                raise ConfigError("--settings: network.variant is each row's own; use --variants")
        c = dataclasses.replace(c, run=dataclasses.replace(c.run, seed=0))
        if num_envs:
            c = dataclasses.replace(c, run=dataclasses.replace(c.run, num_envs=num_envs))
        if samples:
            count = count_iterations(samples, c)
            c = dataclasses.replace(c, run=dataclasses.replace(c.run, iterations=count))
        configs[variant] = distillation.fill_in(robot.fill_in(c))
        limits.check(configs[variant])
    return Plan(
        tuple(variants), tuple(seeds), terrain, device, trials, tuple(settings), engine, devices,
        configs,
    )  # fmt: skip


def count_iterations(samples: float, c: Config) -> int:
    """Count the iterations that have at least so many samples."""
    return math.ceil(samples / (c.run.num_envs * c.ppo.horizon))


def choose_device(requested: str) -> str:
    """Choose the device as `train` does, without taking it."""
    if requested != "auto":
        return requested
    on_cpu = jax.config.jax_platforms == "cpu"
    return "gpu" if jax_setup.has_cuda_plugin() and not on_cpu else "cpu"


def train_words(plan: Plan, row: Row, folder: Path, resume: bool) -> list[str]:
    """Write the command that trains a row, or goes on with it."""
    words = ["train", "--run-dir", str(folder / row.name), "--device", plan.device, "--no-evaluate"]
    words += ["--engine", plan.engine]
    if plan.devices is not None:
        words += ["--devices", str(plan.devices)]
    if resume:
        return [*words, "--resume"]
    run = plan.configs[row.variant].run
    words += ["--terrain", plan.terrain, "--experiment", row.variant, *plan.settings]
    words += ["--seed", str(row.seed), "--num-envs", str(run.num_envs)]
    return [*words, "--iterations", str(run.iterations)]


def environment(plan: Plan) -> dict[str, str]:
    """Choose the variables for a plan's commands, as `eval` has no option for its device."""
    return {"JAX_PLATFORMS": "cpu"} if plan.device == "cpu" else {}


def claim(folder: Path, plan: Plan) -> None:
    """Write the plan into its folder, or compare it with the one that is there.

    Raises:
        ConfigError: that is another one.
    """
    check(folder, plan)
    part = folder / f"{FILE}.part"
    part.write_text(json.dumps(_describe(plan), indent=2) + "\n")
    part.replace(folder / FILE)


def check(folder: Path, plan: Plan) -> None:
    """Compare a plan with the one in the folder, if there is one.

    Raises:
        ConfigError: says what differs.
    """
    path = folder / FILE
    try:
        own = json.loads(path.read_text())
        differences = list(_find_differences(own, json.loads(json.dumps(_describe(plan)))))
    except FileNotFoundError:
        return
    except (OSError, ValueError, AttributeError) as error:
        raise ConfigError(f"{path}: {error}") from None
    asked = [text for text in differences if not text.startswith("configs.")]
    differences = asked or differences  # settings follow from what was asked for
    if differences:
        more = len(differences) - MOST_NAMED
        each = "; ".join(differences[:MOST_NAMED]) + (f"; and {more} more" if more > 0 else "")
        raise ConfigError(f"{folder} holds another plan: {each}; choose another --out")


def _describe(plan: Plan) -> dict[str, Any]:
    configs = {name: dataclasses.asdict(c) for name, c in plan.configs.items()}
    described = {**plan._asdict(), "configs": configs}
    del described["devices"]  # another number of them may go on
    return described


def _find_differences(own: Any, other: Any, where: str = "") -> Iterator[str]:
    """Yield a text for each value that differs; a variant that only one plan has is named once."""
    if not (isinstance(own, Mapping) and isinstance(other, Mapping)):
        if own != other:
            yield f"{where} {_show(own)}, not {_show(other)}"
        return
    for key in own:
        if key in other:
            yield from _find_differences(own[key], other[key], f"{where}.{key}" if where else key)


def _show(value: Any) -> str:
    return " ".join(map(str, value)) or "none" if isinstance(value, list) else str(value)
