"""Pixels in the order in which filters read them; frames by step and by slot."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from cref_jax import config, depth
from cref_jax.network import frame_slots, layers, patches


def test_patches_nest_row_by_row():
    # 4 x 8 pixels under the strides 2 and 2: two tokens of 4 x 4 pixels, each of four patches of
    # 2 x 2. Pixel (r, c) holds 10 r + c
    image = 10 * np.arange(4)[:, None] + np.arange(8)[None]
    found = patches.to_patches(jnp.asarray(image)[..., None], (2, 2))[..., 0]
    assert found.shape == (1, 2, 16)
    assert found[0, 0].tolist() == [0, 1, 10, 11, 2, 3, 12, 13, 20, 21, 30, 31, 22, 23, 32, 33]
    assert found[0, 1, :4].tolist() == [4, 5, 14, 15]


@pytest.mark.parametrize("strides", [(4, 2), (2, 4), (2, 2, 2), (8,), (3, 2)])
def test_an_image_comes_back_from_its_patches(strides):
    image = jax.random.normal(jax.random.key(0), (2, 3, 48, 72, 5))
    side = int(np.prod(strides))
    found = patches.to_patches(image, strides)
    assert found.shape == (2, 3, 48 // side, 72 // side, side * side, 5)
    np.testing.assert_array_equal(patches.to_image(found, strides), image)


def test_filters_on_patches_are_convolutions_of_the_image():
    # two layers with the same parameters, on images and on patches
    image = jax.random.normal(jax.random.key(0), (1, 2, 16, 24, 1))
    first, second = layers.Convolution(3, 4, 4), layers.Convolution(5, 2, 2)
    one = first.init(jax.random.key(1), image)
    middle = layers.elu(first.apply(one, image))
    two = second.init(jax.random.key(2), middle)
    expected = second.apply(two, middle)

    x = patches.to_patches(image, (4, 2)).reshape(-1, 16)
    wide = layers.elu(layers.PatchFilter(3, group=4).apply(one, x))
    assert wide.shape == (1 * 2 * 2 * 3, 4 * 3)
    found = layers.PatchFilter(5).apply(two, wide)
    np.testing.assert_allclose(found.reshape(expected.shape), expected, atol=1e-6)


def test_a_filter_begins_with_the_parameters_of_a_convolution():
    image = jnp.zeros((1, 1, 8, 8, 3))
    ours = layers.PatchFilter(4, group=2).init(jax.random.key(5), jnp.zeros((4, 48)))
    theirs = layers.Convolution(4, 4, 4).init(jax.random.key(5), image)
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)


def test_slots_are_taken_in_turn():
    # frame 0 for two steps, frame 1 for three, frame 2 for one, frame 3 never
    h = frame_slots.assign_slots(jnp.array([0, 0, 1, 1, 1, 2]), frames=4, slots=3)
    assert h.slot.tolist() == [0, 1, 0, 1, 2, 0]
    assert h.taken.astype(int).tolist() == [[1, 1, 0], [1, 1, 1], [1, 0, 0], [0, 0, 0]]
    assert np.asarray(h.step)[np.asarray(h.taken)].tolist() == [0, 1, 2, 3, 4, 5]


def test_what_is_told_by_step_comes_back_from_the_slots_and_so_does_its_gradient():
    h = frame_slots.assign_slots(jnp.array([0, 0, 1, 1, 1, 2]), frames=4, slots=3)
    x = jax.random.normal(jax.random.key(0), (6, 2, 5))
    np.testing.assert_array_equal(
        frame_slots.gather_by_step(frame_slots.gather_by_frame(x, h), h), x
    )

    # the gradients are those of the plain look-ups, which JAX adds up by index
    weight = jax.random.normal(jax.random.key(1), (4, 2, 3, 5))
    taken = jnp.where(h.taken[:, None, :, None], weight, 0.0)
    plain = lambda x: jnp.sum(taken * x[h.step[:, None], jnp.arange(2)[:, None]])
    ours = lambda x: jnp.sum(taken * frame_slots.gather_by_frame(x, h))
    np.testing.assert_allclose(jax.grad(ours)(x), jax.grad(plain)(x), atol=1e-6)

    back = lambda y: jnp.sum(x * y[h.frame, :, h.slot])
    found = jax.grad(lambda y: jnp.sum(x * frame_slots.gather_by_step(y, h)))(weight)
    np.testing.assert_allclose(found, jax.grad(back)(weight), atol=1e-6)


def test_the_longest_hold_is_the_longest_time_between_two_frames():
    camera, period = config.Camera(), 0.02
    due = np.flatnonzero(np.asarray(depth.is_due(np.arange(1, 501), camera, period)))
    assert depth.longest_hold(camera, period) == np.diff(due).max() == 3
    fast = config.override(camera, {"rate": 60.0})  # no more than one a step
    assert depth.longest_hold(fast, period) == 1


def test_the_gradient_of_elu_is_that_of_its_formula():
    # -1: e^-1 = 0.367879; 0: 1, from below; 2: 1
    x = jnp.array([-1.0, 0.0, 2.0])
    np.testing.assert_allclose(layers.elu(x), [-0.632121, 0.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(
        jax.grad(lambda x: layers.elu(x).sum())(x), [0.367879, 1.0, 1.0], atol=1e-6
    )


def test_the_layer_norm_and_its_gradients_are_those_of_flax():
    x = 3.0 + 2.0 * jax.random.normal(jax.random.key(0), (4, 3, 8))
    weight = jax.random.normal(jax.random.key(1), x.shape)
    params = {"params": {"scale": jnp.linspace(0.5, 2.0, 8), "bias": jnp.linspace(-1.0, 1.0, 8)}}

    def of(module):
        return jax.value_and_grad(
            lambda p, x: jnp.sum(weight * module.apply(p, x)), argnums=(0, 1)
        )(params, x)

    for a, b in zip(
        jax.tree.leaves(of(layers.LayerNorm())), jax.tree.leaves(of(nn.LayerNorm())), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=2e-5)
