"""Toy problems with known answers, and the loop that lets PPO learn them.

An episode has a fixed number of steps and ends for good. Actions are real numbers.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from cref_jax import config, ppo
from cref_jax.network import layers, modules


class Toy(NamedTuple):
    """An episode of `length` steps with one number for a state: a cue, at first 1 or -1."""

    length: int
    observe: Callable[[jax.Array, jax.Array], jax.Array]  # (step, cue) -> obs f32[n]
    reward: Callable[[jax.Array, jax.Array, jax.Array], jax.Array]  # (step, cue, action) -> f32
    advance: Callable[[jax.Array, jax.Array, jax.Array], jax.Array] = lambda step, cue, action: cue


class Said(NamedTuple):
    mean: jax.Array
    log_std: jax.Array
    velocity: jax.Array


class Recaller(nn.Module):
    """A small actor; without memory its GRU is emptied at every step."""

    memory: bool = True
    hidden: int = 16

    @nn.compact
    def __call__(self, carry, obs, begins, sight=None):
        begins = begins if self.memory else jnp.ones_like(begins)
        x = nn.elu(nn.Dense(self.hidden, name="enter")(obs))
        carry, y, _ = modules.RecurrentFusion(self.hidden, name="recurrent")(carry, x, begins)
        mean = nn.Dense(1, name="act")(y)
        log_std = self.param("log_std", nn.initializers.constant(-0.5), (1,))
        return carry, Said(mean, log_std, jnp.zeros((*obs.shape[:2], 0)))


class Outcome(NamedTuple):
    """One episode from each first cue, -1 and 1, in which the cue stays as it is."""

    mean_action: jax.Array  # [step, cue]
    value: jax.Array  # [step, cue]


CUES = jnp.array([-1.0, 1.0])


def solve(toy: Toy, c: config.PPO, iterations: int, memory=True, num_envs=64, seed=0) -> Outcome:
    """Learn the toy by PPO and say how the learnt policy behaves."""
    actor, width = Recaller(memory), toy.observe(jnp.array(0), jnp.array(1.0)).size
    value_net = layers.MLP((32, 1), name="value")
    networks = ppo.Networks(actor.apply, lambda p, s: value_net.apply(p, s)[..., 0])
    key_actor, key_critic, key = jax.random.split(jax.random.key(seed), 3)
    no, empty = jnp.zeros((1, 1), bool), lambda n: jnp.zeros((n, actor.hidden))
    params = ppo.Params(
        actor.init(key_actor, empty(1), jnp.zeros((1, 1, width)), no),
        value_net.init(key_critic, jnp.zeros((1, 1, 2))),
    )
    state = ppo.initial_state(params, width, 2, c)

    def iteration(state, key):
        key_play, key_learn = jax.random.split(key)
        rollout = play(toy, state, networks, empty(num_envs), key_play, c.horizon)
        return ppo.update(state, rollout, key_learn, c, networks)

    keys = jax.random.split(key, iterations)
    state, _ = jax.jit(lambda s: jax.lax.scan(iteration, s, keys))(state)
    return judge(toy, state, networks, empty(2))


def critic_sees(step, cue):
    return jnp.stack([step.astype(float) * jnp.ones_like(cue), cue], axis=-1)


def play(toy, state, networks, carry, key, horizon) -> ppo.Rollout:
    """Play whole episodes, one after the other, for `horizon` steps."""
    assert horizon % toy.length == 0, "a rollout holds whole episodes"
    start, num_envs = carry, carry.shape[0]

    def step(carry, at):
        (memory, cue), (t, key) = carry, at
        key_cue, key_action = jax.random.split(key)
        phase = t % toy.length
        begins = jnp.full((1, num_envs), phase == 0)
        cue = jnp.where(begins[0], jax.random.rademacher(key_cue, (num_envs,), float), cue)
        obs = jax.vmap(toy.observe, (None, 0))(phase, cue)
        seen = critic_sees(phase, cue)
        normal = ppo.normalize(state.statistics.obs, obs)
        memory, said = networks.actor(state.params.actor, memory, normal[None], begins)
        noise = jax.random.normal(key_action, said.mean[0].shape)
        action = said.mean[0] + jnp.exp(said.log_std) * noise
        reward = jax.vmap(toy.reward, (None, 0, 0))(phase, cue, action[:, 0])
        following = toy.advance(phase, cue, action[:, 0])
        value = lambda s: networks.critic(
            state.params.critic, ppo.normalize(state.statistics.critic_obs, s)[None]
        )[0]
        ended = jnp.full(num_envs, phase == toy.length - 1)
        emitted = ppo.Rollout(
            obs=obs,
            critic_obs=seen,
            velocity=said.velocity[0],
            action=action,
            mean=said.mean[0],
            log_std=jnp.broadcast_to(said.log_std, action.shape),
            reward=reward,
            value=value(seen),
            next_value=value(critic_sees(phase + 1, following)),
            terminated=ended,
            truncated=jnp.zeros_like(ended),
            begins=begins[0],
            valid=jnp.ones_like(ended),
            carry=(),
        )
        return (memory, following), emitted

    at = (jnp.arange(horizon), jax.random.split(key, horizon))
    _, rollout = jax.lax.scan(step, (carry, jnp.ones(num_envs)), at)
    return rollout._replace(carry=start)


def judge(toy, state, networks, carry) -> Outcome:
    """Return the mean action and the value in every step, for both cues."""
    phases = jnp.arange(toy.length)
    obs = jax.vmap(lambda t: jax.vmap(toy.observe, (None, 0))(t, CUES))(phases)
    begins = jnp.zeros((toy.length, 2), bool).at[0].set(True)
    normal = ppo.normalize(state.statistics.obs, obs)
    _, said = networks.actor(state.params.actor, carry, normal, begins)
    seen = jax.vmap(lambda t: critic_sees(t, CUES))(phases)
    value = networks.critic(state.params.critic, ppo.normalize(state.statistics.critic_obs, seen))
    return Outcome(said.mean[..., 0], value)
