"""Graceful shutdown on Ctrl-C or SIGTERM."""

import os
import signal
import sys
from types import FrameType


class StopRequest:
    """Records the first Ctrl-C or SIGTERM so that work can be saved; the second exits at once."""

    def __init__(self) -> None:
        self.requested = False

    def __enter__(self) -> "StopRequest":
        signals = (signal.SIGINT, signal.SIGTERM)
        self._before = {number: signal.signal(number, self._request) for number in signals}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            os._exit(128 + number)
        self.requested = True
        print("saving, then stopping; interrupt again to stop at once", file=sys.stderr)
