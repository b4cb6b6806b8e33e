"""Recurrent PPO, which knows nothing of robots."""

from cref_jax.ppo.advantages import gae, prepare_batch, zero_invalid
from cref_jax.ppo.learner import adapt, initial_state, minibatches, optimiser, update
from cref_jax.ppo.normalization import (
    OBSERVATION_CLIP,
    STD_RANGE,
    VARIANCE_FLOOR,
    Count,
    RunningStatistics,
    initial_statistics,
    normalise,
    observe,
)
from cref_jax.ppo.records import (
    Actor,
    Batch,
    Losses,
    Mirror,
    Networks,
    Params,
    Prediction,
    Rollout,
    Statistics,
    TrainState,
)

__all__ = [
    "OBSERVATION_CLIP",
    "STD_RANGE",
    "VARIANCE_FLOOR",
    "Actor",
    "Batch",
    "Count",
    "Losses",
    "Mirror",
    "Networks",
    "Params",
    "Prediction",
    "Rollout",
    "RunningStatistics",
    "Statistics",
    "TrainState",
    "adapt",
    "gae",
    "initial_state",
    "initial_statistics",
    "minibatches",
    "normalise",
    "observe",
    "optimiser",
    "prepare_batch",
    "update",
    "zero_invalid",
]
