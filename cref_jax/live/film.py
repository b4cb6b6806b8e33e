"""Films of what a session did, as `play` and the scene suite draw them."""

import itertools
from collections.abc import Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from cref_jax import robot, terrain
from cref_jax.live.stage import Stage
from cref_jax.rendering import policy_overlay, robot_scene, video
from cref_jax.whole_body import scene_files
from cref_jax.whole_body.ground import Lane

RATE = 25.0  # 1/s, of simulated time
MOST_SECONDS = 120.0  # of simulated time; what comes later is not filmed
SIZE = (960, 540)  # pixels, of the scene
BEHIND = (12.0, -24.0)  # deg, azimuth and elevation in a scene: no wall is in the way


class Moment(NamedTuple):
    """What a film needs of one moment."""

    episode: int
    qpos: Float[np.ndarray, " Q"]
    frame: Float[np.ndarray, "H W"] | None  # m
    attention: Float[np.ndarray, " N"] | None
    gate: Float[np.ndarray, " D"]


class Film(NamedTuple):
    """Moments on one stage, at `RATE`."""

    stage: Stage
    moments: list[Moment]

    @property
    def is_full(self) -> bool:
        """Whether there is no more room in it."""
        return len(self.moments) >= MOST_SECONDS * RATE


def write_film(out: Path, film: Film) -> None:
    """Write a film as .mp4.

    Raises:
        ConfigError: OpenGL is not available, or the file cannot be written.
    """
    view = () if isinstance(film.stage.ground, Lane) else BEHIND
    with robot_scene.Canvas(_build_model(film.stage), *SIZE, *view) as canvas:
        video.write_video(out, _draw(canvas, film), RATE)


def _build_model(stage: Stage) -> mujoco.MjModel:
    """Build the model to draw."""
    c, ground = stage.body.config, stage.ground
    if isinstance(ground, Lane):
        lane = terrain.from_heights(ground.heights, ground.cell, ground.origin)
        return robot_scene.build("all", c.physics, lane, c.robot.name)
    z = -scene_files.DITCH - robot_scene.BASE
    spec = robot_scene.build_stage("all", c.physics, z, c.robot.name)
    ground.add_to(spec, robot.FRICTION)
    return spec.compile()


def _draw(canvas: robot_scene.Canvas, film: Film) -> Iterator[robot_scene.Frame]:
    """Draw each moment, with what the policy saw beside it."""
    c = film.stage.body.config
    sees = c.network.sees
    for _, group in itertools.groupby(film.moments, attrgetter("episode")):
        moments = list(group)
        points = robot_scene.camera_path(np.stack([m.qpos for m in moments]), 1.0 / RATE)
        for t, moment in enumerate(moments):
            world = canvas.draw(moment.qpos, points[t])
            mind = _view_policy(moments[: t + 1], c.camera.d_max)
            side = policy_overlay.draw(mind, SIZE[1], c.camera.d_max, 1.0 / RATE, sees)
            yield np.concatenate([world, side], axis=1)


def _view_policy(moments: Sequence[Moment], d_max: float) -> policy_overlay.PolicyView:
    """Collect what the policy sees at the last of these moments, and its gate until then."""
    now = moments[-1]
    depth = None if now.frame is None else np.minimum(now.frame / d_max, 1.0) - 0.5
    gates = [m.gate for m in moments[-round(policy_overlay.SECONDS * RATE) :]]
    return policy_overlay.PolicyView(depth, now.attention, np.stack(gates))
