"""Recurrent PPO, which knows nothing of robots."""

from cref_jax.ppo.advantages import gae, prepare_batch, zero_invalid
from cref_jax.ppo.learner import (
    adapt_learning_rate,
    average_share,
    initial_state,
    minibatches,
    optimizer,
    update,
)
from cref_jax.ppo.normalization import (
    OBSERVATION_CLIP,
    STD_RANGE,
    VARIANCE_FLOOR,
    Count,
    RunningStatistics,
    initial_statistics,
    normalize,
    update_statistics,
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
    "adapt_learning_rate",
    "average_share",
    "gae",
    "initial_state",
    "initial_statistics",
    "minibatches",
    "normalize",
    "optimizer",
    "prepare_batch",
    "update",
    "update_statistics",
    "zero_invalid",
]
