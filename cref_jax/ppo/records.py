"""Records of PPO: networks and parameters, rollouts and batches, losses."""

from collections.abc import Callable
from typing import NamedTuple, Protocol, no_type_check

import jax
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PyTree, Shaped

from cref_jax.ppo.auxiliary import Readout
from cref_jax.ppo.normalization import RunningStatistics


class Prediction(Protocol):
    """Actor output: action distribution and estimated base velocity."""

    mean: Float[Array, "T E J"]
    log_std: Float[Array, " J"]
    velocity: Float[Array, "T E V"]
    feature: Float[Array, "T E D"]  # input of the action head; used only by a readout


# (params, carry, obs [T, E, O], begins [T, E], sight) -> (carry, prediction)
Actor = Callable[[PyTree, PyTree, Array, Array, PyTree], tuple[PyTree, Prediction]]


class Mirror(NamedTuple):
    """Reflections of observations, images and actions; each is its own inverse."""

    obs: Callable[[Array], Array]  # raw, [..., O]
    frames: Callable[[Array], Array]
    sight: Callable[[PyTree], PyTree]
    action: Callable[[Array], Array]  # [..., J]


class Networks(NamedTuple):
    """The two trained functions, of normalised observations."""

    actor: Actor
    # (params, critic_obs [T, E, S]) -> value [T, E]
    critic: Callable[[PyTree, Array], Array]
    mirror: Mirror | None = None  # symmetry taught to the actor, if any


class Params(NamedTuple):
    """The parameters that the optimiser updates."""

    actor: PyTree
    critic: PyTree
    readout: Readout | None = None  # of the last M of the critic's observations


class Batch(NamedTuple):
    """Input of the loss: normalised rollout with advantages and returns; invalid samples zeroed."""

    obs: Float[Array, "T E O"]
    critic_obs: Float[Array, "T E S"]
    velocity: Float[Array, "T E V"]
    action: Float[Array, "T E J"]
    mean: Float[Array, "T E J"]
    log_std: Float[Array, "T E J"]
    value: Float[Array, "T E"]
    advantage: Float[Array, "T E"]  # mean 0 and deviation 1 over the valid samples
    returns: Float[Array, "T E"]
    begins: Bool[Array, "T E"]
    valid: Bool[Array, "T E"]
    carry: PyTree[Float[Array, "E ?H"]]
    sight: PyTree[Shaped[Array, "?K E *?n"]] = None
    twin: PyTree[Float[Array, "E ?H"]] = None
    twin_obs: Float[Array, "T E O"] | None = None  # mirrored observations
    target: Float[Array, "T E J"] | None = None  # the teachers' mean action; NaN: there is none


class Losses(NamedTuple):
    """Unweighted loss terms of one minibatch, and diagnostics of the step."""

    surrogate: Float[Array, "*n"]
    value: Float[Array, "*n"]
    velocity: Float[Array, "*n"]  # m^2/s^2
    readout: Float[Array, "*n"]  # in units of each target's variance
    asymmetry: Float[Array, "*n"]  # of the mean action, squared
    teacher_kl: Float[Array, "*n"]  # KL(teacher || policy) at the policy's deviations, nats
    entropy: Float[Array, "*n"]  # nats
    kl: Float[Array, "*n"]  # KL(behaviour policy || current policy), nats
    clipped: Float[Array, "*n"]  # share of samples whose ratio is outside the clip range
    gradient_norm: Float[Array, "*n"] | float = 0.0  # before clipping
    learning_rate: Float[Array, "*n"] | float = 0.0
    skipped: Float[Array, "*n"] | float = 0.0  # 1 where the gradient was not finite


class Statistics(NamedTuple):
    """Running mean and deviation of each network's observations."""

    obs: RunningStatistics
    critic_obs: RunningStatistics


@no_type_check  # vmap and tree.map fill it with batches and with non-arrays
@struct.dataclass
class TrainState:
    """The learner's state between iterations."""

    params: Params
    average: PyTree  # of the actor's parameters over recent iterations, to reduce noise
    opt_state: optax.OptState  # includes the learning rate and the count of bad gradients
    statistics: Statistics
    iteration: Int[Array | jax.ShapeDtypeStruct, "*seeds"]  # a ShapeDtypeStruct in eval_shape
    teacher: PyTree = None  # parameters of the actor that this one learns from, if any


class Rollout(NamedTuple):
    """T steps of E environments under one policy. Observations are raw."""

    obs: Float[Array, "T E O"]
    critic_obs: Float[Array, "T E S"]
    velocity: Float[Array, "T E V"]  # target of the estimator
    action: Float[Array, "T E J"]
    mean: Float[Array, "T E J"]  # of the action distribution
    log_std: Float[Array, "T E J"]  # of the action distribution
    reward: Float[Array, "T E"]
    value: Float[Array, "T E"]  # V of the state before the action
    next_value: Float[Array, "T E"]  # V of the state after the step, before any reset
    terminated: Bool[Array, "T E"]  # the episode ended in this step; no value follows
    truncated: Bool[Array, "T E"]  # the episode was cut off after this step
    begins: Bool[Array, "T E"]  # first step of an episode: memory is reset before it
    valid: Bool[Array, "T E"]  # False where the simulation failed; the next step must have `begins`
    carry: PyTree[Float[Array, "E ?H"]]  # the actor's memory before the first step
    sight: PyTree[Shaped[Array, "?K E *?n"]] = None  # further inputs of the actor, unnormalised
    twin: PyTree[Float[Array, "E ?H"]] = None  # memory of the mirrored actor before the first step
    guide: PyTree[Shaped[Array, "T E *?n"]] = None  # what a teacher sees besides, unnormalised
    target: Float[Array, "T E J"] | None = None  # the teachers' mean action; NaN: there is none
