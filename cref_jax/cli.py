"""Shared by the commands: one-line errors and checks of output files."""

import contextlib
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cref_jax.errors import CheckpointError, ConfigError, TrainingError


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


@contextlib.contextmanager
def one_line_errors(debug: bool = False, is_program: bool = True) -> Iterator[None]:
    """Print errors a user can fix as one line on stderr and exit with 2; `debug` re-raises them.

    Failed training exits with 1, Ctrl-C with 130, unless a notebook or a script has called the
    command, which goes on.
    """
    try:
        yield
    except (ConfigError, CheckpointError, TrainingError) as error:
        if debug:
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1 if isinstance(error, TrainingError) else 2)
    except KeyboardInterrupt:
        if not is_program:
            raise
        print("interrupted", file=sys.stderr)
        sys.stdout.flush()
        os._exit(130)  # at once: a running XLA program may still call into this interpreter


def prepare_output(out: Path, suffix: str, option: str = "--out") -> Path:
    """Check that a file can be written, create its folder and return its path.

    Raises:
        ConfigError: its name does not end in `suffix`, or it cannot be written.
    """
    if out.suffix != suffix:
        raise ConfigError(f"{option} must end in {suffix}: {out}")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot make the folder {out.parent}: {error.strerror}") from None
    if out.is_dir() or not os.access(out if out.exists() else out.parent, os.W_OK):
        raise ConfigError(f"cannot write {out}")
    return out
