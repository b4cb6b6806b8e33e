"""Where each foot may step on a lane, as in training."""

from typing import Optional

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from cref_jax import config, terrain
from cref_jax.env import footholds
from cref_jax.live.session import View
from cref_jax.live.stage import Stage
from cref_jax.terrain import Terrain
from cref_jax.whole_body.ground import Lane


class FootholdSearch:
    """Finds the candidates of both feet from their last contact, with the footholds of training."""

    def __init__(self, lane: Lane, c: config.Foothold) -> None:
        self._ground = terrain.from_heights(jnp.asarray(lane.heights), lane.cell, lane.origin)
        self._c = c
        self._points = jax.jit(_find_points, static_argnames="c")

    @classmethod
    def on(cls, stage: Stage) -> Optional["FootholdSearch"]:
        """Build the search of a stage; None for a scene, which is no grid of columns."""
        ground = stage.ground
        return cls(ground, stage.body.config.foothold) if isinstance(ground, Lane) else None

    def find(self, view: View) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
        """Find the points, m, and the foot of each."""
        forward = jnp.float32(view.command[0])
        sole, heading = view.soles.astype(np.float32), view.headings.astype(np.float32)
        points = np.asarray(self._points(self._ground, sole, heading, forward, self._c))
        accepted = np.isfinite(points[..., 0])
        return points[accepted], np.nonzero(accepted)[0]


def _find_points(
    ground: Terrain,
    sole: Float[Array, "2 3"],
    heading: Float[Array, "2"],
    forward: Float[Array, ""],
    c: config.Foothold,
) -> Float[Array, "2 K 3"]:
    return footholds.points(footholds.candidates(ground, sole, heading, forward, c))
