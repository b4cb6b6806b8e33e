"""Policies with random parameters, and inputs for them."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from cref_jax import config, network, ppo, robot
from cref_jax.config import Config
from cref_jax.env import observations
from cref_jax.policy import reference_vectors, trained
from cref_jax.policy.manifest import build_manifest
from cref_jax.training import pytree_digest

ROBOT = robot.load(config.Robot())
J = ROBOT.num_joints
OBS = observations.slices(J)["action"].stop
SMALL = config.Network(
    convolutions=((4, 4, 4), (8, 3, 2)),
    token=8, heads=2, compressed=4, lstm=6, gru=7, actor=(9, 5), critic=(4,),
)  # fmt: skip


@functools.cache
def policy(
    variant: config.Variant, net: config.Network = SMALL, name: str | None = None
) -> trained.TrainedPolicy:
    """Return a policy whose every parameter matters, and which has seen observations.

    It is of the robot `name`, which has legs of J joints as the first one has.
    """
    c = robot.fill_in(Config(), name)
    c = dataclasses.replace(c, network=dataclasses.replace(net, variant=variant))
    actor, carry = network.build_actor(c.network, J), network.initial_carry(c.network, 1)
    sight = None
    if variant != "blind":
        zero = jnp.zeros((1, 1), jnp.int32)
        sight = network.DepthInput(
            network.image_to_patches(c.network, jnp.zeros((1, 1, *c.camera.shape))), zero, zero > 0
        )
    key = jax.random.key(3)
    begins = jnp.zeros((1, 1), bool)
    params = jax.jit(actor.init)(key, carry, jnp.zeros((1, 1, OBS)), begins, sight)
    flat, tree = jax.tree.flatten(params)
    drawn = [
        leaf + 0.05 * jax.random.normal(k, leaf.shape)
        for k, leaf in zip(jax.random.split(key, len(flat)), flat, strict=True)
    ]
    params = ppo.Params(jax.tree.unflatten(tree, drawn), {})
    train = ppo.initial_state(params, OBS, 1, c.ppo)
    mean, std = 0.2 * jax.random.normal(key, (OBS,)), jnp.linspace(0.2, 2.0, OBS)
    obs = train.statistics.obs.replace(mean=mean, std=std)
    train = train.replace(statistics=train.statistics._replace(obs=obs))
    return trained.TrainedPolicy(c, train, 7, Path("runs/none"), trained.count_samples(c, 7))


def contents(p: trained.TrainedPolicy) -> tuple[dict, dict[str, np.ndarray]]:
    """Return the manifest without digests, and the weights."""
    driven = robot.load(p.config.robot)
    return build_manifest(p, driven), pytree_digest.on_host(p.train.params.actor["params"])


def recorded(count: int, sees: bool = True, seed: int = 0) -> reference_vectors.SensorLog:
    """Return random inputs that could be true: resets, and frames at no regular rate."""
    rng = np.random.default_rng(seed)
    draw = lambda *shape: rng.standard_normal(shape).astype(np.float32)
    gravity = np.clip(draw(count, 3), -1.5, 1.5) * np.float32(0.2) + np.float32([0, 0, -1])
    gravity /= np.linalg.norm(gravity, axis=1, keepdims=True)
    low, high = ROBOT.range_low, ROBOT.range_high
    q = low + (high - low) * rng.random((count, J), np.float32)
    reset, fresh = rng.random(count) < 0.02, rng.random(count) < 0.4
    q[reset | (np.arange(count) == 0)] = ROBOT.nominal_pose  # a robot starts standing
    image = rng.uniform(-0.5, 0.5, (count, 48, 64)).astype(np.float16)
    which = np.maximum.accumulate(np.where(fresh, np.arange(count), 0))
    return reference_vectors.SensorLog(
        angular_velocity=draw(count, 3),
        gravity=gravity,
        command=rng.uniform([0, -0.3, -1], [1, 0.3, 1], (count, 3)).astype(np.float32),
        q=q,
        qd=3 * draw(count, J),
        reset=reset,
        image=image[which] if sees else None,
        fresh=fresh if sees else np.zeros(count, bool),
    )


def metres(image: np.ndarray, d_max: float = 3.0) -> np.ndarray:
    """Return the depth that reads as this image, m; the far plane as a miss."""
    depth = (image.astype(np.float32) + np.float32(0.5)) * np.float32(d_max)
    return np.where(image == 0.5, np.inf, np.maximum(depth, 1e-6)).astype(np.float32)
