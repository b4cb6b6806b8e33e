"""The number of parameters of networks."""

import dataclasses
from collections.abc import Mapping

import jax

from cref_jax.config import Config
from cref_jax.env.world import build_world
from cref_jax.robot import fill_in
from cref_jax.training import iteration

ROBOTS = 4  # the smallest number that splits into minibatches; the networks do not depend on it


def count_parameters(configs: Mapping[str, Config]) -> dict[str, dict[str, int]]:
    """Count the parameters of each module of the actor, and of the critic, with these settings.

    They may differ in the network alone. A policy that has a teacher is counted without it.
    """
    small = {
        name: fill_in(dataclasses.replace(c, run=dataclasses.replace(c.run, num_envs=ROBOTS)))
        for name, c in configs.items()
    }
    world = build_world(next(iter(small.values())))
    size = lambda tree: sum(leaf.size for leaf in jax.tree.leaves(tree))
    counts = {}
    for name, c in small.items():
        params = jax.eval_shape(iteration.initial_state, world.replace(config=c)).train.params
        parts = {part: size(tree) for part, tree in params.actor["params"].items()}
        counts[name] = {**parts, "critic": size(params.critic)}
    return counts
