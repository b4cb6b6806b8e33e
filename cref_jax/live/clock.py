"""Real time: steps a session at the asked share of it, and measures the share that it reaches."""

import collections
import threading
import time

from cref_jax.live.session import Session

LEAST, MOST = 0.1, 1.0  # of real time
MEASURED = 2.0  # s of wall time that the measured share is an average over
BEHIND = 0.2  # s; farther behind, the clock gives up what it has missed


class Clock:
    """Steps a session in a thread of its own; `speed`, `paused` and `share` are of real time."""

    def __init__(self, session: Session) -> None:
        self.speed, self.paused = 1.0, False
        self._session, self._over = session, threading.Event()
        self._lock = threading.Lock()
        self._done: collections.deque[float] = collections.deque()  # s, wall time of each step
        self._thread = threading.Thread(target=self._run, name="simulation", daemon=True)
        self.failure: Exception | None = None  # of the newest step

    def start(self) -> None:
        """Begin to step."""
        self._thread.start()

    def stop(self) -> None:
        """Step no more."""
        self._over.set()
        self._thread.join()

    def step_once(self) -> None:
        """Pause and make one control step."""
        self.paused = True
        self._session.step()
        self.failure = None

    @property
    def share(self) -> float:
        """Simulated time per wall time, over the last `MEASURED` seconds."""
        now = time.perf_counter()
        with self._lock:
            recent = [at for at in self._done if at > now - MEASURED]
        if len(recent) < 2:
            return 0.0
        return (len(recent) - 1) * self._session.period / (now - recent[0])

    def _run(self) -> None:
        due = time.perf_counter()
        while not self._over.is_set():
            if self.paused:
                with self._lock:
                    self._done.clear()
                self._over.wait(0.02)
                due = time.perf_counter()
                continue
            try:
                self._session.step()
                self.failure = None
            except Exception as error:
                self.failure, self.paused = error, True
                continue
            now = time.perf_counter()
            with self._lock:
                self._done.append(now)
                while self._done[0] < now - MEASURED:
                    self._done.popleft()
            due = max(due, now - BEHIND) + self._session.period / self.speed
            self._over.wait(max(0.0, due - now))
