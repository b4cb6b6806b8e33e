"""T steps of E robots under a policy: the one place where the environment meets the learner.

Training and evaluation share it. The robots' axis is E, and every record is [T, E, ...].
"""

from typing import NamedTuple, no_type_check

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cref_jax import config, env, episode, network, ppo
from cref_jax.env import Outcome
from cref_jax.episode import Ending, EnvState
from cref_jax.observation import Observation
from cref_jax.world import World


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@flax.struct.dataclass
class Robots:
    """E robots between two control steps, with what their policy remembers."""

    env: EnvState
    observation: Observation
    memory: network.Carry
    begins: Bool[Array, " E"]  # the next step is the first of an episode


class _Step(NamedTuple):
    """What a horizon is made of, one control step of it."""

    observation: Observation  # that the action was taken on
    begins: Bool[Array, " E"]
    action: Float[Array, "E J"]
    mean: Float[Array, "E J"]
    log_std: Float[Array, "E J"]
    outcome: Outcome


class Trace(NamedTuple):
    """What happened at each step, apart from what the update needs."""

    reward: Float[Array, "T E"]
    ending: Ending
    measures: env.Measures


def networks(c: config.Network, num_actions: int) -> ppo.Networks:
    """Return the actor and the critic as functions of their parameters."""
    actor, critic = network.Actor(c, num_actions), network.Critic(c)
    return ppo.Networks(actor=actor.apply, critic=critic.apply)


def initial_params(
    c: config.Network, num_actions: int, robots: Robots, key: PRNGKeyArray
) -> ppo.Params:
    """Return fresh parameters for observations of the robots' shapes."""
    key_actor, key_critic = jax.random.split(key)
    seen = robots.observation
    one = lambda x: x[None, :1]
    memory = network.initial_carry(c, 1)
    actor = network.Actor(c, num_actions)
    return ppo.Params(
        actor=actor.init(key_actor, memory, one(seen.proprioception), one(robots.begins)),
        critic=network.Critic(c).init(key_critic, one(seen.privileged)),
    )


def start(world: World, key: PRNGKeyArray, num_envs: int) -> Robots:
    """Put E robots on their lanes: kinds in turn, low levels at random, episodes out of step."""
    c = world.config
    key_level, key_reset, key_see, key_step = jax.random.split(key, 4)
    kinds = jnp.arange(num_envs) % len(world.lanes.kinds)
    highest = min(c.curriculum.start_level, world.lanes.levels - 1)
    levels = jax.random.randint(key_level, (num_envs,), 0, highest + 1)
    split = lambda k: jax.random.split(k, num_envs)
    state = jax.vmap(episode.reset, in_axes=(None, 0, 0, 0))(world, split(key_reset), kinds, levels)
    longest = round(c.episode.length / c.physics.control_period)
    state = state.replace(step=jax.random.randint(key_step, (num_envs,), 0, longest))
    seen = jax.vmap(env.observe, in_axes=(None, 0, 0))(world, state, split(key_see))
    return Robots(
        env=state,
        observation=seen,
        memory=network.initial_carry(c.network, num_envs),
        begins=jnp.ones(num_envs, bool),
    )


def act(
    nets: ppo.Networks, train: ppo.TrainState, robots: Robots
) -> tuple[network.Carry, network.Output]:
    """Return the policy's memory after this step and its outputs, [1, E, ...]."""
    obs = ppo.normalise(train.statistics.obs, robots.observation.proprioception)
    return nets.actor(train.params.actor, robots.memory, obs[None], robots.begins[None])


def advance(
    world: World, robots: Robots, memory: network.Carry, action: Float[Array, "E J"]
) -> tuple[Robots, Outcome]:
    """Step every robot with its action."""
    state, outcome = jax.vmap(env.step, in_axes=(None, 0, 0))(world, robots.env, action)
    over = outcome.ending.terminated | outcome.ending.truncated
    return Robots(state, outcome.observation, memory, begins=over), outcome


def collect(
    world: World, nets: ppo.Networks, train: ppo.TrainState, robots: Robots, key: PRNGKeyArray
) -> tuple[Robots, ppo.Rollout, Trace]:
    """Return a horizon of experience, with actions drawn from the policy."""

    def step(robots: Robots, key: PRNGKeyArray) -> tuple[Robots, _Step]:
        memory, policy = act(nets, train, robots)
        mean = policy.mean[0]
        action = mean + jnp.exp(policy.log_std) * jax.random.normal(key, mean.shape)
        after, outcome = advance(world, robots, memory, action)
        log_std = jnp.broadcast_to(policy.log_std, mean.shape)
        return after, _Step(robots.observation, robots.begins, action, mean, log_std, outcome)

    keys = jax.random.split(key, world.config.ppo.horizon)
    after, steps = jax.lax.scan(step, robots, keys)
    value = lambda s: nets.critic(
        train.params.critic, ppo.normalise(train.statistics.critic_obs, s)
    )
    outcome = steps.outcome
    rollout = ppo.Rollout(
        obs=steps.observation.proprioception,
        critic_obs=steps.observation.privileged,
        velocity=steps.observation.velocity,
        action=steps.action,
        mean=steps.mean,
        log_std=steps.log_std,
        reward=outcome.reward,
        value=value(steps.observation.privileged),
        next_value=value(outcome.last_privileged),
        terminated=outcome.ending.terminated,
        truncated=outcome.ending.truncated,
        begins=steps.begins,
        valid=~outcome.ending.unstable,
        carry=robots.memory,
    )
    return after, rollout, Trace(outcome.reward, outcome.ending, outcome.measures)
