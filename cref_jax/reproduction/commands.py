"""Commands of this program as processes of their own, one at a time.

Each has memory, compiled programs and devices to itself, and ends when this process does.
"""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from types import FrameType

START = (sys.executable, "-c", "from cref_jax.system import tied; tied.run()")
PAUSE = 600.0  # s between two calls of `on_wait`


class Runner:
    """Runs commands, and passes Ctrl-C, SIGTERM and the end of the terminal on to them.

    `signal` is the first of those that came, or None: after it no other command is to be started.
    SIGHUP stays ignored under nohup. `environment` are variables for all commands.
    """

    def __init__(self, **environment: str) -> None:
        self._environment = environment
        self.signal: int | None = None
        self._child: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "Runner":
        signals = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
        if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
            signals.remove(signal.SIGHUP)
        self._before = {number: signal.signal(number, self._pass_on) for number in signals}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def run(self, words: Sequence[str], on_wait: Callable[[], None] = lambda: None) -> int:
        """Run a command, such as `train --terrain gap`, to its end, and return its exit code.

        It is a process group of its own, so that the terminal's Ctrl-C reaches it through this
        process alone: a second one would end it before it has saved. It saves as well where
        `on_wait` raises.
        """
        command, environment = [*START, *words], {**os.environ, **self._environment}
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, process_group=0, env=environment
        ) as child:
            self._child = child
            if self.signal is not None:  # it came before there was a child to pass it on to
                child.send_signal(self.signal)
            while True:
                try:
                    return child.wait(PAUSE)
                except subprocess.TimeoutExpired:
                    with self._saving(child):
                        on_wait()

    @contextlib.contextmanager
    def _saving(self, child: "subprocess.Popen[bytes]") -> Iterator[None]:
        """On an error let the command save, since to close its standard input ends it at once."""
        try:
            yield
        except BaseException:
            if self.signal is None:  # else it is stopping already
                child.terminate()
            child.wait()
            raise

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        self.signal = self.signal or number
        if self._child:
            self._child.send_signal(number)  # none to one that has ended
