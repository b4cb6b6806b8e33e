"""Graceful shutdown on Ctrl-C, SIGTERM, or the end of the terminal."""

import contextlib
import os
import signal
import sys
import threading
from types import FrameType


class StopRequest:
    """Records the first Ctrl-C, SIGTERM or SIGHUP so that work can be saved.

    The second one ends the program at once. A second Ctrl-C is a KeyboardInterrupt, so that a
    notebook stays alive. SIGHUP stays ignored under nohup.
    """

    def __init__(self) -> None:
        self.requested = False

    def __enter__(self) -> "StopRequest":
        signals = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
        if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
            signals.remove(signal.SIGHUP)
        if threading.current_thread() is not threading.main_thread():
            signals = []  # Python gives signals to the main thread alone
        self._before = {number: signal.signal(number, self._request) for number in signals}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        if self.requested:
            os._exit(128 + number)
        self.requested = True
        with contextlib.suppress(OSError):  # the terminal may be gone
            print("saving, then stopping; interrupt again to stop at once", file=sys.stderr)
