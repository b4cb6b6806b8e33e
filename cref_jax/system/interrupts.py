"""A polite end on Ctrl-C or SIGTERM."""

import os
import signal
import sys
from types import FrameType


class StopRequest:
    """Notes the first Ctrl-C or SIGTERM, so that the work can be saved; the second ends at once."""

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> "StopRequest":
        signals = (signal.SIGINT, signal.SIGTERM)
        self._before = {number: signal.signal(number, self._ask) for number in signals}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            os._exit(128 + number)
        self.asked = True
        print("saving, then stopping; once more to stop at once", file=sys.stderr)
