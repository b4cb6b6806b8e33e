"""Graceful shutdown on Ctrl-C, SIGTERM, or the end of the terminal."""

import contextlib
import os
import signal
import sys
import threading
import time
from types import FrameType
from typing import NoReturn

ONE_REQUEST = 1.0  # s; assumed: a terminal that closes sends SIGHUP twice within a millisecond


def end_interrupted() -> NoReturn:
    """Say that Ctrl-C has come, and end this process with exit code 130."""
    print("interrupted", file=sys.stderr)
    sys.stdout.flush()
    os._exit(130)  # at once: a running XLA program may still call into this interpreter


def _end(number: int, frame: FrameType | None) -> None:
    end_interrupted()


def end_while_loading() -> None:
    """End at Ctrl-C until `raise_from_here`: what is imported may swallow an exception."""
    is_main = threading.current_thread() is threading.main_thread()
    if is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def raise_from_here() -> None:
    """Let Ctrl-C be a KeyboardInterrupt again."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


class StopRequest:
    """Records the first Ctrl-C, SIGTERM or SIGHUP so that work can be saved.

    Another one ends the program at once, unless it comes within `ONE_REQUEST` of the first. As
    Ctrl-C it is a KeyboardInterrupt, so that a notebook stays alive. SIGHUP stays ignored under
    nohup.
    """

    def __init__(self) -> None:
        self.requested = False
        self._requested_at = 0.0

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
        if self.requested and time.monotonic() - self._requested_at < ONE_REQUEST:
            return
        if self.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        if self.requested:
            os._exit(128 + number)
        self.requested, self._requested_at = True, time.monotonic()
        with contextlib.suppress(OSError):  # the terminal may be gone
            print("saving, then stopping; interrupt again to stop at once", file=sys.stderr)
