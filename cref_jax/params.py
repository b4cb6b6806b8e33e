"""Count the parameters of each variant of the network: `python -m cref_jax.params`."""

import cref_jax.system.startup  # noqa: F401

import typing
from dataclasses import dataclass

import jax
from rich.console import Console
from rich.table import Table

from cref_jax import cli, config
from cref_jax.config import Config, presets
from cref_jax.env.world import build_world
from cref_jax.training import iteration


@dataclass(frozen=True)
class Options(cli.DebugOption):
    """Count the parameters of each variant by module."""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    with cli.one_line_errors(arguments):
        cli.parse(Options, arguments, "params")
        Console().print(
            build_table({name: count_parameters(name) for name in typing.get_args(config.Variant)})
        )


def count_parameters(variant: config.Variant) -> dict[str, int]:
    """Count the parameters of each module of the actor, and of the critic, in its experiment."""
    c = config.override(presets.apply_file(Config(), variant), {"run": {"num_envs": 4}})
    params = jax.eval_shape(iteration.initial_state, build_world(c)).train.params
    size = lambda tree: sum(leaf.size for leaf in jax.tree.leaves(tree))
    parts = {part: size(tree) for part, tree in params.actor["params"].items()}
    return {**parts, "critic": size(params.critic)}


def build_table(counts: dict[str, dict[str, int]]) -> Table:
    """Build the table of counts with a column per variant."""
    result = Table(title="parameters")
    result.add_column("part")
    for variant in counts:
        result.add_column(variant, justify="right")
    parts = sorted({part for parts in counts.values() for part in parts} - {"critic"})
    for part in parts:
        result.add_row(part, *(f"{c[part]:,}" if part in c else "-" for c in counts.values()))
    result.add_section()
    policy = {v: sum(c.values()) - c["critic"] for v, c in counts.items()}
    result.add_row("policy", *(f"{total:,}" for total in policy.values()))
    result.add_row("critic", *(f"{c['critic']:,}" for c in counts.values()))
    return result


if __name__ == "__main__":
    main()
