"""How far a row came in its training's curriculum, by kind of lane.

After few samples variants differ here, when every cell of Table II is still near 0.
"""

import math
from pathlib import Path
from typing import Any

from cref_jax.errors import ConfigError
from cref_jax.pages import training_log
from cref_jax.policy import trained
from cref_jax.reproduction.plan import Plan, Row

SHARE = 0.05  # of the iterations, over which a level is averaged; assumed: the noise is gone
MOST_POINTS = 100  # per curve
PREFIX = "level/"  # of the log's columns, one per kind of lane
WITHOUT_SIZE = ("flat",)  # kinds whose lanes are all alike


def read_levels(folder: Path, plan: Plan, row: Row) -> dict[str, Any] | None:
    """Read a row's levels over its samples; None before it has logged any.

    Each is the mean over the robots on lanes of the kind and over `SHARE` of the iterations.
    """
    try:
        log = training_log.read(folder / row.name / "log.jsonl")
    except ConfigError:
        return None
    c = plan.configs[row.variant]
    window = math.ceil(SHARE * c.run.iterations)
    at = training_log.even_indices(len(log["iteration"]), MOST_POINTS)
    kinds = [n.removeprefix(PREFIX) for n in log.columns if n.startswith(PREFIX)]
    levels = {
        kind: [_round(level) for level in training_log.smooth(log, PREFIX + kind, window)[at]]
        for kind in kinds
        if kind not in WITHOUT_SIZE
    }
    samples = [trained.count_samples(c, int(n)) for n in log["iteration"][at]]
    return {"samples": samples, "levels": levels} if levels else None


def _round(level: float) -> float | None:
    """Round to a hundredth; None for a level that was not logged, as JSON has no NaN."""
    return round(float(level), 2) if math.isfinite(level) else None
