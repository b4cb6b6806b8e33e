"""What comes back of a run where its robots do not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import small_world
from tiny_policy import SMALL

from cref_jax import config
from cref_jax.training import iteration, resumption
from cref_jax.training.checkpoint import Checkpoints
from cref_jax.training.randomization_ramp import Ramp


def state_of(num_envs):
    c = config.override(small_world.C, {"run": {"num_envs": num_envs}})
    world = small_world.world().replace(config=dataclasses.replace(c, network=SMALL))
    return jax.jit(iteration.initial_state)(world)


def test_with_other_robots_what_was_learned_and_how_much_is_randomised_stay(tmp_path):
    stored, fresh = state_of(4), state_of(8)
    train = stored.train.replace(iteration=jnp.int32(7))
    stored = stored.replace(train=train, ramp=Ramp(jnp.float32(0.7), jnp.float32(1.5)))
    with Checkpoints(tmp_path) as steps:
        steps.save(7, stored, {"num_envs": 4, "shares": 1})
        back = resumption.restore(steps, fresh, {"num_envs": 8, "shares": 1})
    assert (int(back.train.iteration), back.robots.begins.shape) == (7, (8,))
    assert float(back.ramp.share) == np.float32(0.7)
