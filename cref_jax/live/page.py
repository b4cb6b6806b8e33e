"""The page: panels, scene, and the loop that keeps them up to date."""

import contextlib
import io
import threading
import time
from pathlib import Path

import viser

from cref_jax.live.choice_panel import ChoicePanel
from cref_jax.live.clock import Clock
from cref_jax.live.drawing import Drawing
from cref_jax.live.drive_panel import DrivePanel
from cref_jax.live.film_panel import FilmPanel
from cref_jax.live.session import Session
from cref_jax.live.sight_panel import SightPanel
from cref_jax.live.stage import Stage, StageBuilder
from cref_jax.live.training_panel import TrainingPanel

FRAME_RATE = 25.0  # 1/s, of the scene
PICTURES = 3  # frames of the scene per picture of what the policy sees


class Page:
    """One session in all viewers' browsers."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        builder: StageBuilder,
        run: Path | None = None,
    ) -> None:
        """Lay out the page; with a run, each new checkpoint is taken as it comes."""
        self._server, self._session = server, session
        self.clock = Clock(session)
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        server.gui.set_panel_label("cref_jax")
        server.gui.main_panel.dock_right()
        self._drive = DrivePanel(server, session, self.clock)
        self._choice = ChoicePanel(server, session, builder, self._take_stage)
        FilmPanel(server, session, self._choice.complain)
        self._sight = SightPanel(server)
        self._training = TrainingPanel(self._sight.panel, server, session, run) if run else None
        self._drawing = Drawing(server)
        self._over = threading.Event()

    def run(self) -> None:
        """Simulate and draw until `stop` or Ctrl-C."""
        self.clock.start()
        if self._training:
            self._training.start()
        due, count = time.perf_counter(), 0
        try:
            while not self._over.is_set():
                if self._server.get_clients() or count == 0:
                    self._draw(count)
                count += 1
                now = time.perf_counter()
                due = max(due + 1.0 / FRAME_RATE, now)
                self._over.wait(due - now)
        finally:
            self.clock.stop()

    def stop(self) -> None:
        """Let `run` return."""
        self._over.set()

    def close(self) -> None:
        """Listen no more."""
        with contextlib.redirect_stdout(io.StringIO()):  # it would say so
            self._server.stop()

    def _draw(self, count: int) -> None:
        view = self._session.view()
        self._drawing.draw(view)
        if count % PICTURES == 0:
            self._sight.draw_picture(view)
        elif count % PICTURES == 1:
            self._sight.write(view, self.clock)
            self._drive.refresh()
        else:
            self._drawing.draw_candidates(view)

    def _take_stage(self, stage: Stage) -> None:
        self._drive.set_limits()
