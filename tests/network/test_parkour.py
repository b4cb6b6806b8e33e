"""The network of Humanoid Parkour Learning: what its teacher and its student read."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cref_jax import config, network
from cref_jax.network.parkour import PooledFilter

T, E, J, OBS = 3, 2, 4, 5
C = config.Network(convolutions=((4, 3, 2),), compressed=6, token=8, gru=7, actor=(9,))
NEVER = jnp.zeros((T, E), bool)


def test_a_filter_has_no_padding_and_keeps_the_largest_of_each_block():
    # sums over 2 x 2 pixels of 3 x 3: 12, 16, 24, 28, one block; negated, -12 is the largest. The
    # fourth column makes sums of a third that fill no block
    image = jnp.array([[1.0, 2, 3, 50], [4, 5, 6, 50], [7, 8, 9, 50]])[None, None, :, :, None]
    for sign, expected in ((1.0, 28.0), (-1.0, math.exp(-12.0) - 1.0)):
        weights = {"kernel": jnp.full((4, 1), sign), "bias": jnp.zeros(1)}
        found = PooledFilter(1, 2, 2).apply({"params": {"filter": weights}}, image)
        assert found.shape == (1, 1, 1, 1, 1)
        np.testing.assert_allclose(found.ravel(), [expected], rtol=1e-6)


@pytest.mark.parametrize(("kernel", "pool"), [(3, 2), (2, 3), (3, 1)])
def test_a_filter_is_a_convolution_then_a_largest_of_windows(kernel, pool):
    image = jax.random.normal(jax.random.key(0), (1, 5, 9, 12, 2))
    net = PooledFilter(4, kernel, pool)
    params = net.init(jax.random.key(1), image)["params"]["filter"]
    params["bias"] = jnp.arange(4.0)
    weights = params["kernel"].reshape(kernel, kernel, 2, 4)
    axes = ("NHWC", "HWIO", "NHWC")
    y = jax.lax.conv_general_dilated(image[0], weights, (1, 1), "VALID", dimension_numbers=axes)
    window = (1, pool, pool, 1)
    y = jax.lax.reduce_window(y + params["bias"], -jnp.inf, jax.lax.max, window, window, "VALID")
    found = net.apply({"params": {"filter": params}}, image)[0]
    np.testing.assert_allclose(found, jax.nn.elu(y), atol=1e-5)


def actor(variant):
    c = config.override(C, {"variant": variant})
    return network.build_actor(c, J), network.initial_carry(c, E)


def inputs(variant):
    """Return observations, and heights or frames, of which the first robot has none yet."""
    obs = jax.random.normal(jax.random.key(1), (T, E, OBS))
    if variant == "hpl_teacher":
        return obs, jax.random.normal(jax.random.key(2), (T, E, 12))
    image = jax.random.uniform(jax.random.key(2), (1, E, 8, 8))
    frames = network.image_to_patches(C, image)
    seen = jnp.broadcast_to(jnp.array([False, True]), (T, E))
    return obs, network.DepthInput(frames, jnp.zeros((T, E), jnp.int32), seen, T)


@pytest.mark.parametrize("variant", config.HPL)
def test_what_is_seen_changes_the_action_and_a_new_episode_forgets_it(variant):
    net, carry = actor(variant)
    obs, sight = inputs(variant)
    params = net.init(jax.random.key(0), carry, obs, NEVER, sight)
    act = lambda sight, begins: net.apply(params, carry, obs, begins, sight)[1]
    other = jax.tree.map(lambda x: 2 * x if x.dtype == jnp.float32 else x, sight)
    changed = np.abs(act(sight, NEVER).mean - act(other, NEVER).mean).max(axis=-1)
    assert changed[:, 1].min() > 0.0
    assert (changed[:, 0].max() > 0.0) == (variant == "hpl_teacher")  # who has seen nothing
    anew = NEVER.at[1].set(True)
    alone = net.apply(params, carry, obs[1:], NEVER[1:], _later(sight))[1].mean
    np.testing.assert_allclose(act(sight, anew).mean[1:], alone, atol=1e-6)
    assert np.abs(act(sight, NEVER).mean[1:] - alone).max() > 1e-5


def _later(sight):
    """Return what is seen from the second step on."""
    if isinstance(sight, network.DepthInput):
        return sight.replace(held=sight.held[1:], seen=sight.seen[1:])
    return sight[1:]


@pytest.mark.parametrize("variant", config.HPL)
def test_the_action_is_decoded_from_memory_and_no_velocity_is_estimated(variant):
    net, carry = actor(variant)
    obs, sight = inputs(variant)
    params = net.init(jax.random.key(0), carry, obs, NEVER, sight)
    after, out = net.apply(params, carry, obs, NEVER, sight)
    np.testing.assert_array_equal(out.feature[-1], after.gru)
    assert not np.any(out.velocity) and np.all(out.gate == 1.0) and out.attention is None
    assert not np.any(after.lstm_c)
