"""The records of PPO: what is trained, what was experienced, what was lost."""

from collections.abc import Callable
from typing import NamedTuple, Protocol, no_type_check

import jax
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PyTree, Shaped

from cref_jax.ppo.auxiliary import Readout
from cref_jax.ppo.normalization import RunningStatistics


class Prediction(Protocol):
    """What an actor says: a Gaussian over actions, and what it takes its velocity for."""

    mean: Float[Array, "T E J"]
    log_std: Float[Array, " J"]
    velocity: Float[Array, "T E V"]
    feature: Float[Array, "T E D"]  # that the mean is read off; only a readout looks at it


# (params, carry, obs [T, E, O], begins [T, E], sight) -> (carry, prediction)
Actor = Callable[[PyTree, PyTree, Array, Array, PyTree], tuple[PyTree, Prediction]]


class Mirror(NamedTuple):
    """A symmetry of the world: what its mirror image senses, sees and does. Each undoes itself."""

    obs: Callable[[Array], Array]  # raw, [..., O]
    frames: Callable[[Array], Array]
    sight: Callable[[PyTree], PyTree]
    action: Callable[[Array], Array]  # [..., J]


class Networks(NamedTuple):
    """The two functions that are trained. They take normalised observations."""

    actor: Actor
    # (params, critic_obs [T, E, S]) -> value [T, E]
    critic: Callable[[PyTree, Array], Array]
    mirror: Mirror | None = None  # the symmetry that the actor is taught, if any


class Params(NamedTuple):
    """What the optimiser changes."""

    actor: PyTree
    critic: PyTree
    readout: Readout | None = None  # of the last M of the critic's observations


class Batch(NamedTuple):
    """What the loss looks at: a rollout normalised, judged and free of invalid numbers."""

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
    twin_obs: Float[Array, "T E O"] | None = None  # what it senses


class Losses(NamedTuple):
    """Unweighted parts of the loss of one minibatch, and how the step went."""

    surrogate: Float[Array, "*n"]
    value: Float[Array, "*n"]
    velocity: Float[Array, "*n"]  # m^2/s^2
    readout: Float[Array, "*n"]  # in variances of what is read out
    asymmetry: Float[Array, "*n"]  # of the mean action, squared
    entropy: Float[Array, "*n"]  # nats
    kl: Float[Array, "*n"]  # nats, of the behaviour policy from the present one
    clipped: Float[Array, "*n"]  # share of samples whose ratio is outside the clip range
    gradient_norm: Float[Array, "*n"] | float = 0.0  # before clipping
    learning_rate: Float[Array, "*n"] | float = 0.0
    skipped: Float[Array, "*n"] | float = 0.0  # 1 where the gradient was not finite


class Statistics(NamedTuple):
    """Running mean and deviation of what each network sees."""

    obs: RunningStatistics
    critic_obs: RunningStatistics


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@struct.dataclass
class TrainState:
    """Everything that learning carries from one iteration to the next."""

    params: Params
    average: PyTree  # of the actor's parameters, over the last iterations: steadier than they are
    opt_state: optax.OptState  # holds the learning rate and the count of bad gradients, too
    statistics: Statistics
    iteration: Int[Array | jax.ShapeDtypeStruct, "*seeds"]  # or its shape alone, in eval_shape


class Rollout(NamedTuple):
    """T steps of E environments under one policy. Observations are raw."""

    obs: Float[Array, "T E O"]
    critic_obs: Float[Array, "T E S"]
    velocity: Float[Array, "T E V"]  # what the estimator should have said
    action: Float[Array, "T E J"]
    mean: Float[Array, "T E J"]  # of the distribution that the action came from
    log_std: Float[Array, "T E J"]  # of the distribution that the action came from
    reward: Float[Array, "T E"]
    value: Float[Array, "T E"]  # V of the state that the action was taken in
    next_value: Float[Array, "T E"]  # V of the state that the step led to, before any reset
    terminated: Bool[Array, "T E"]  # the episode ended in this step, and nothing follows
    truncated: Bool[Array, "T E"]  # the episode was cut off after this step
    begins: Bool[Array, "T E"]  # this step is the first of an episode: memory is empty before it
    valid: Bool[Array, "T E"]  # False where the simulation failed; the next step must begin anew
    carry: PyTree[Float[Array, "E ?H"]]  # the actor's memory before the first step
    sight: PyTree[Shaped[Array, "?K E *?n"]] = None  # what the actor looks at besides, as it is
    twin: PyTree[Float[Array, "E ?H"]] = None  # the memory of an actor that lives in the mirror
