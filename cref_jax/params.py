"""Count the parameters of each variant of the network: `python -m cref_jax.params`."""

import cref_jax.system.startup  # noqa: F401

import typing
from dataclasses import dataclass

from rich.table import Table

from cref_jax import cli, config
from cref_jax.config import Config, presets
from cref_jax.training.parameter_count import count_parameters


@dataclass(frozen=True)
class Options(cli.DebugOption):
    """Count the parameters of each variant by module."""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    with cli.one_line_errors(arguments):
        cli.parse(Options, arguments, "params")
        names = typing.get_args(config.Variant)
        configs = {name: presets.apply_file(Config(), name) for name in names}
        cli.print_table(build_table(count_parameters(configs)))


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
