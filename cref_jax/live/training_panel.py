"""A training as it goes on: its learning curve, and each new checkpoint for the robot."""

import logging
import threading
from pathlib import Path

import numpy as np
import viser
from jaxtyping import Float
from viser import uplot

from cref_jax.env.world import build_world
from cref_jax.errors import CheckpointError, ConfigError
from cref_jax.live import policies
from cref_jax.live.policies import Loaded
from cref_jax.live.session import Session
from cref_jax.pages import training_log
from cref_jax.training import run_dir

LOG = logging.getLogger(__name__)
POLL = 5.0  # s
MOST_POINTS = 300  # per curve
WINDOW = 20  # iterations that a point is the mean of
HEIGHT = 170  # pixels of a chart
CURVES = {  # column of the log: title and colour
    "episode/length_s": ("episode length, s, by M samples", "#1d4e80"),
    "walk/speed_error": ("speed error, m/s, by M samples", "#b5432a"),
}


class TrainingPanel:
    """Charts of a run's log beside the scene; a thread looks for what is new."""

    def __init__(
        self, panel: viser.PanelHandle, server: viser.ViserServer, session: Session, run: Path
    ) -> None:
        self._session, self._run = session, run
        with panel.add_tab("Training", viser.Icon.CHART_LINE):
            self._said = server.gui.add_markdown("")
            self._charts = {
                column: server.gui.add_uplot(
                    (np.zeros(2), np.zeros(2)),
                    (
                        uplot.Series(label="samples, M"),
                        uplot.Series(label=title, stroke=colour, width=2),
                    ),
                    title=title,
                    scales={"x": uplot.Scale(time=False)},
                    legend=uplot.Legend(show=False),
                    height=HEIGHT,
                )
                for column, (title, colour) in CURVES.items()
            }

    def start(self) -> None:
        """Look for new checkpoints and lines of the log from now on."""
        threading.Thread(target=self._watch, name="training", daemon=True).start()

    def _watch(self) -> None:
        world = build_world(run_dir.read_config(self._run), "mujoco")
        known, wait = None, threading.Event()
        policy: Loaded | None = None  # that does not walk yet
        with run_dir.checkpoints(self._run) as steps:
            while True:
                newest = steps.latest()
                try:
                    self._draw()
                    if newest != known:
                        policy, known = policies.load(self._run, world), newest
                    if policy and self._offer(policy):
                        policy = None
                except (CheckpointError, ConfigError) as error:
                    LOG.info("%s", error)  # it is being written or removed: look again
                wait.wait(POLL)

    def _offer(self, policy: Loaded) -> bool:
        """Let the robot walk with a new checkpoint, unless another policy was chosen meanwhile."""
        is_taken = self._session.take_policy(policy)
        when = "walks from the next start on" if is_taken else "is there, but another policy walks"
        self._said.content = f"{policy.detail} {when}"
        return is_taken

    def _draw(self) -> None:
        log = training_log.read(self._run / "log.jsonl")
        samples = log["train/samples"] / 1e6
        at = training_log.even_indices(len(samples), MOST_POINTS)
        for column, chart in self._charts.items():
            if column in log:
                curve: Float[np.ndarray, " N"] = training_log.smooth(log, column, WINDOW)
                known = at[np.isfinite(curve[at])]
                if len(known) > 1:
                    chart.data = (samples[known], curve[known])
