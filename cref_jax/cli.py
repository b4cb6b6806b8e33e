"""Shared by the commands: their options, one-line errors and checks of output files."""

import contextlib
import io
import itertools
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import tyro
from rich.console import Console
from rich.table import Table

from cref_jax.config.ranges import check_ranges, declared_ranges
from cref_jax.errors import CheckpointError, ConfigError, TrainingError
from cref_jax.system import interrupts

R = TypeVar("R")
READER_GONE = 141  # exit code of a program that SIGPIPE ends
TABLE_WIDTH = 1000  # characters; assumed: more than any table has


@dataclass(frozen=True)
class DebugOption:
    """The option that every command has."""

    debug: bool = False
    """show the traceback of an error"""


@dataclass(frozen=True)
class PolicyOptions(DebugOption):
    """The options of a command that looks at one policy."""

    run: Path | None = None
    """runs/NAME (default: the newest run, or the bundled policy where there is none)"""
    policy: Path | None = None
    """an exported policy instead of a run"""
    robot: str | None = None
    """a robot by name: its newest run (default: any); another robot's is an error"""


def parse(options: type[R], arguments: Sequence[str] | None, command: str) -> R:
    """Parse the options of a command, and check their numbers.

    Raises:
        ConfigError: a number is out of the range that its field is annotated with, or an argument
            is empty.
    """
    check_arguments(sys.argv[1:] if arguments is None else arguments)
    parsed = tyro.cli(options, args=arguments, prog=f"python -m cref_jax.{command}")
    check_ranges(parsed, declared_ranges(options))
    return parsed


def check_arguments(arguments: Sequence[str]) -> None:
    """Refuse empty values: as a path they would be the current folder, as a name no name.

    Raises:
        ConfigError: names the option.
    """
    for before, argument in itertools.pairwise(["", *arguments]):
        is_empty_option = argument.startswith("--") and argument.endswith("=")
        if not argument or is_empty_option:
            option = argument.removesuffix("=") or before or "an argument"
            raise ConfigError(f"{option} is empty; is a shell variable not set?")


@contextlib.contextmanager
def one_line_errors(arguments: Sequence[str] | None = None) -> Iterator[None]:
    """Print errors a user can fix as one line on stderr and exit with 2; --debug re-raises them.

    Failed training exits with 1, Ctrl-C with 130, output that nobody reads with 141. A notebook or
    a script that has called the command with `arguments` goes on after Ctrl-C.
    """
    is_program = arguments is None
    interrupts.raise_from_here()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal of few characters loses no result
    try:
        with _flushed():
            yield
    except BrokenPipeError:
        if not is_program:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # flushed once more at exit
        sys.exit(READER_GONE)
    except (ConfigError, CheckpointError, TrainingError, OSError) as error:
        if "--debug" in (sys.argv if arguments is None else arguments):
            raise
        print(f"error: {_one_line(error)}", file=sys.stderr)
        sys.exit(1 if isinstance(error, TrainingError) else 2)
    except KeyboardInterrupt:
        if not is_program:
            raise
        interrupts.end_interrupted()


@contextlib.contextmanager
def _flushed() -> Iterator[None]:
    """Flush stdout where all went well, --help included, so that a closed pipe is noticed here."""
    try:
        yield
    except SystemExit:
        sys.stdout.flush()
        raise
    sys.stdout.flush()


def _one_line(error: Exception) -> str:
    """Write an error as one line; what the system refuses comes with the file that it is about."""
    message = str(error)
    if isinstance(error, OSError) and error.strerror is not None:
        file = f"{error.filename}: " if error.filename else ""
        message = f"{file}{error.strerror}"
    return " ".join(message.splitlines())  # a name may have any characters


def prepare_output(out: Path, suffix: str, option: str = "--out") -> Path:
    """Check that a file can be written, create its folder and return its path.

    Raises:
        ConfigError: its name does not end in `suffix`, or it cannot be written.
    """
    if out.suffix != suffix:
        raise ConfigError(f"{option} must end in {suffix}: {out}")
    prepare_folder(out.parent)
    is_new = not out.exists()
    try:
        out.open("ab").close()  # permissions alone do not tell, such as root's or on a network disk
        if is_new:
            out.unlink()
    except OSError as error:
        raise ConfigError(f"cannot write {out}: {error.strerror}") from None
    return out


def prepare_folder(folder: Path) -> Path:
    """Create a folder for output, check that files can be written there, and return it.

    Raises:
        ConfigError: it cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot make the folder {folder}: {error.strerror}") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError(f"cannot write in the folder {folder}")
    return folder


def print_table(table: Table) -> None:
    """Print a table in its own width: a narrower terminal breaks its lines, and cuts no number."""
    Console(width=TABLE_WIDTH).print(table)
