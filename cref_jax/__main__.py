"""One door to all commands: `cref train` is `python -m cref_jax.train`, and so on."""

import cref_jax.system.startup  # noqa: F401

import ast
import difflib
import importlib.util
import runpy
import sys
from pathlib import Path

from cref_jax import cli
from cref_jax.errors import ConfigError
from cref_jax.system import interrupts

COMMANDS = (
    "train",
    "eval",
    "play",
    "report",
    "export",
    "sim2sim",
    "bench",
    "gpu_program",
    "params",
    "doctor",
    "reproduce",
)
DEMO = ("play", "--live", "--browser", "--policy", "robust")  # needs no training


def main(arguments: list[str] | None = None) -> None:
    """Run a command; without one, or with --help, list them."""
    with cli.one_line_errors(arguments):
        name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
        if name in ("-h", "--help"):
            print(_describe_commands())
            return
        if name == "demo":
            name, *rest = [*DEMO, *rest]
        name = name.replace("-", "_")
        if name not in COMMANDS:
            near = difflib.get_close_matches(name, (*COMMANDS, "demo"), n=1)
            hint = f"did you mean {near[0]}?" if near else "cref --help lists them"
            raise ConfigError(f"unknown command '{name}'; {hint}")
        sys.argv[1:] = rest
        interrupts.end_while_loading()
        try:
            runpy.run_module(f"cref_jax.{name}", run_name="__main__", alter_sys=True)
        finally:
            interrupts.raise_from_here()


def _describe_commands() -> str:
    """List the commands, each with the first line of its file."""
    lines = ["usage: cref COMMAND [OPTIONS]; each command has --help", ""]
    lines.append(f"  {'demo':<12} Drive the bundled policy in the browser; needs no training.")
    for name in COMMANDS:
        spec = importlib.util.find_spec(f"cref_jax.{name}")
        assert spec and spec.origin
        said = ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))) or ""
        text = said.partition("\n")[0].partition(": `")[0].rstrip(".")
        lines.append(f"  {name:<12} {text}.")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
