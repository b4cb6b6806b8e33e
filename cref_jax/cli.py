"""What the commands share: errors of one line, and a polite end on Ctrl-C."""

import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from types import FrameType

from cref_jax.checkpoint import CheckpointError
from cref_jax.config import ConfigError


class TrainingError(RuntimeError):
    """Training cannot go on; the message is one line that says why."""


@contextlib.contextmanager
def one_line_errors(debug: bool = False) -> Iterator[None]:
    """Turn what a user can mend into one line on stderr and exit code 2; `debug` lets it through.

    Training that has gone wrong exits with 1, Ctrl-C with 130.
    """
    try:
        yield
    except (ConfigError, CheckpointError, TrainingError) as error:
        if debug:
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1 if isinstance(error, TrainingError) else 2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)


class StopRequest:
    """Notes the first Ctrl-C or SIGTERM, so that the work can be saved; the second ends at once."""

    def __init__(self) -> None:
        self.asked = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            os._exit(128 + number)
        self.asked = True
        print("saving, then stopping; once more to stop at once", file=sys.stderr)
