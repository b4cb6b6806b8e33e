"""The networks that see: tokens, attention, held frames and the ablations."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from cref_jax import config, network
from cref_jax.network import frame_slots, layers, modules

T, E, K, OBS, J = 6, 3, 3, 7, 2
TOKENS = 48
C = config.Network(token=8, heads=2, compressed=4, lstm=10, gru=12, actor=(16,), critic=(16,))
HELD = np.array([0, 0, 1, 1, 1, 2])
VARIANTS = ("full", "no_cross_attention", "no_grf", "no_highway")


def some_sight(held=HELD, seed=5):
    images = jax.random.uniform(jax.random.key(seed), (K, E, 48, 64), minval=-0.5, maxval=0.5)
    frames = network.image_to_patches(C, images)
    seen = jnp.ones((len(held), E), bool).at[:2, 1].set(False)
    return network.DepthInput(frames, jnp.broadcast_to(held[:, None], (len(held), E)), seen)


@pytest.fixture(scope="module")
def obs():
    return jax.random.normal(jax.random.key(1), (T, E, OBS))


NEVER = jnp.zeros((T, E), bool)
START = network.initial_carry(C, E)


def actor(variant="full"):
    return network.Actor(config.override(C, {"variant": variant}), J)


def parameters(variant, obs):
    """Return parameters whose biases and head are not near zero, so that every path matters."""
    params = jax.jit(actor(variant).init)(jax.random.key(0), START, obs, NEVER, some_sight())
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(7), len(leaves))
    shift = lambda key, leaf: leaf + 0.1 * jax.random.normal(key, leaf.shape)
    return jax.tree.unflatten(tree, map(shift, keys, leaves))


@pytest.fixture(scope="module")
def params(obs):
    return parameters("full", obs)


run = jax.jit(actor().apply)


def test_held_frames_give_the_actions_and_gradients_of_a_frame_at_every_step(params, obs):
    cached = some_sight()
    every = cached.replace(
        frames=cached.frames[HELD], held=jnp.broadcast_to(jnp.arange(T)[:, None], (T, E))
    )

    def loss(params, sight):
        _, out = actor().apply(params, START, obs, NEVER, sight)
        return jnp.sum(out.mean**2) + jnp.sum(out.velocity**2), out

    grad = jax.jit(jax.grad(loss, has_aux=True))
    (ours, out), (theirs, expected) = grad(params, cached), grad(params, every)
    np.testing.assert_allclose(out.mean, expected.mean, atol=1e-6)
    np.testing.assert_allclose(out.attention, expected.attention, atol=1e-6)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5 * (1e-3 + np.abs(b).max()))


def test_stepping_with_cached_features_agrees_with_the_whole_sequence(params, obs):
    sight = some_sight()
    _, whole = run(params, START, obs, NEVER, sight)
    encode = jax.jit(lambda p, f: actor().apply(p, f, method="encode"))
    decide = jax.jit(lambda *x: actor().apply(*x, method="decide"))
    carry = START
    for t in range(T):
        features = encode(params, sight.frames[HELD[t]][None])
        view = network.EncodedInput(features, jnp.zeros((1, E), int), sight.seen[t][None])
        carry, out = decide(params, carry, obs[t][None], NEVER[:1], view)
        np.testing.assert_allclose(out.mean[0], whole.mean[t], atol=1e-5)
        np.testing.assert_allclose(out.velocity[0], whole.velocity[t], atol=1e-5)


def test_a_frame_that_has_not_been_seen_changes_nothing(params, obs):
    sight = some_sight()
    other = sight.replace(frames=sight.frames.at[0, 1].set(0.3))  # held while robot 1 sees nothing
    _, out = run(params, START, obs, NEVER, sight)
    _, same = run(params, START, obs, NEVER, other)
    np.testing.assert_array_equal(out.mean, same.mean)
    _, seen = run(params, START, obs, NEVER, other.replace(seen=jnp.ones((T, E), bool)))
    assert np.abs(seen.mean[0, 1] - out.mean[0, 1]).max() > 1e-4


def test_a_robot_sees_its_own_frames_alone(params, obs):
    def one(frames):
        _, out = run(params, START, obs, NEVER, some_sight().replace(frames=frames))
        return jnp.sum(out.mean[:, 1] ** 2)

    reach = jax.jit(jax.grad(one))(some_sight().frames)
    assert np.any(reach[1, 1]) and not np.any(np.delete(reach, 1, axis=1))


def test_attention_agrees_with_projected_keys_and_values():
    # the textbook form, with K and V written out
    x = jax.random.normal(jax.random.key(0), (T, E, 8))
    tokens = jax.random.normal(jax.random.key(1), (T, E, TOKENS, 8))
    module = modules.CrossAttention(heads=2)
    every = frame_slots.assign_slots(jnp.arange(T), T, 1)
    params = jax.jit(module.init)(jax.random.key(2), x, tokens, every)
    found, weights = jax.jit(module.apply)(params, x, tokens, every)

    p = params["params"]
    query = nn.LayerNorm().apply({"params": p["norm"]}, x) @ p["query"]["kernel"]
    split = lambda y: y.reshape(*y.shape[:-1], 2, 4)
    keys, values = split(tokens @ p["key"]), split(tokens @ p["value"])
    scores = np.einsum("tehk,tenhk->tehn", split(query), keys) / math.sqrt(4)
    expected = jax.nn.softmax(scores)
    mixed = np.einsum("tehn,tenhk->tehk", expected, values).reshape(T, E, 8)
    np.testing.assert_allclose(weights, expected, atol=1e-6)
    np.testing.assert_allclose(found, mixed @ p["output"]["kernel"], atol=1e-5)


def test_attention_finds_the_token_that_answers_the_query():
    # one head, all projections the identity: LN of (1, -1) is (1, -1) itself; token 3 is 50 times
    # that and all others are 0, so its score is 50 * 2 / sqrt(2) = 70.7 against 0: weight 1
    eye = jnp.eye(2)
    params = {
        "norm": {"scale": jnp.ones(2), "bias": jnp.zeros(2)},
        "query": {"kernel": eye},
        "key": eye,
        "value": eye,
        "output": {"kernel": eye},
    }
    tokens = jnp.zeros((1, 1, TOKENS, 2)).at[0, 0, 3].set(jnp.array([50.0, -50.0]))
    found, weights = modules.CrossAttention(heads=1).apply(
        {"params": params},
        jnp.array([[[1.0, -1.0]]]),
        tokens,
        frame_slots.assign_slots(jnp.zeros(1, int), 1, 1),
    )
    assert int(weights[0, 0, 0].argmax()) == 3
    np.testing.assert_allclose(weights[0, 0, 0, 3], 1.0, atol=1e-6)
    np.testing.assert_allclose(found[0, 0], [50.0, -50.0], rtol=1e-5)


@pytest.mark.parametrize(("kernel", "stride"), [(3, 2), (5, 2), (4, 4), (2, 2), (3, 1)])
def test_convolution_agrees_with_xla(kernel, stride):
    x = jax.random.normal(jax.random.key(0), (2, 3, 8, 12, 5))
    module = layers.Convolution(7, kernel, stride)
    params = jax.jit(module.init)(jax.random.key(1), x)
    ours = jax.jit(module.apply)(params, x)
    filters = params["params"]["filter"]["kernel"].reshape(kernel, kernel, 5, 7)
    expected = jax.lax.conv_general_dilated(
        x.reshape(6, 8, 12, 5),
        filters,
        (stride, stride),
        "SAME",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    np.testing.assert_allclose(ours.reshape(expected.shape), expected, atol=1e-5)


def test_tokens_are_local_and_in_the_order_of_the_image():
    frames = jnp.zeros((1, 1, 48, 64))
    tokenizer = modules.DepthTokenizer(C)
    tokens = jax.jit(lambda p, images: tokenizer.apply(p, network.image_to_patches(C, images)))
    params = jax.jit(tokenizer.init)(jax.random.key(0), network.image_to_patches(C, frames))
    flat = tokens(params, frames)
    spot = tokens(params, frames.at[0, 0, 16:20, 32:36].set(1.0))
    moved = np.flatnonzero(np.abs(spot - flat)[0, 0].max(axis=-1) > 1e-6)
    # 4 x 4 pixels to a patch: the spot is patch (4, 8). Token (r, c) looks at 3 x 3 patches from
    # (2 r, 2 c) on, so rows 1 and 2 and columns 3 and 4 see it: tokens 8 r + c
    assert moved.tolist() == [11, 12, 19, 20]


def test_compression_is_a_layer_on_the_means_of_blocks():
    frames = jnp.zeros((1, 1, 48, 64)).at[0, 0, 8:16, 16:24].set(0.5)  # block row 1, column 2
    c = config.override(C, {"compressed": 3})
    module, frames = modules.DepthCompression(c), network.image_to_patches(c, frames)
    params = jax.jit(module.init)(jax.random.key(0), frames)
    kernel = params["params"]["layer_0"]["kernel"]
    expected = nn.elu(0.5 * kernel[1 * 8 + 2])
    np.testing.assert_allclose(jax.jit(module.apply)(params, frames)[0, 0], expected, atol=1e-6)


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_part_of_every_variant_learns(variant, obs):
    params = parameters(variant, obs)

    def loss(params):
        _, out = actor(variant).apply(params, START, obs, NEVER, some_sight())
        return jnp.sum(out.mean**2) + jnp.sum(out.velocity**2) + jnp.sum(out.log_std**2)

    grads = jax.jit(jax.grad(loss))(params)
    still = [
        jax.tree_util.keystr(path, simple=True, separator="/")
        for path, g in jax.tree_util.tree_leaves_with_path(grads)
        if not np.any(g)
    ]
    assert still == []


def test_each_ablation_takes_away_its_part_alone(obs):
    parts = {v: set(parameters(v, obs)["params"]) for v in VARIANTS}
    assert parts["full"] - parts["no_cross_attention"] == {"cross_attention"}
    assert parts["no_cross_attention"] - parts["full"] == {"pooled_tokens"}
    assert parts["no_grf"] == parts["no_highway"] == parts["full"]
    fusion = {v: set(parameters(v, obs)["params"]["fusion"]) for v in ("full", "no_grf")}
    assert fusion == {"full": {"norm", "mix", "content_gate"}, "no_grf": {"norm", "mix", "content"}}
    recurrent = parameters("no_highway", obs)["params"]["recurrent_fusion"]
    assert set(recurrent) == {"gru", "memory_out"}


def test_without_the_highway_the_feature_reaches_the_action_through_memory_alone(obs):
    f = jax.random.normal(jax.random.key(0), (T, E, 3))
    fusion = modules.RecurrentFusion(5, highway=False)
    params = jax.jit(fusion.init)(jax.random.key(1), jnp.zeros((E, 5)), f, NEVER)
    _, y, gate = jax.jit(fusion.apply)(params, jnp.zeros((E, 5)), f, NEVER)
    p = params["params"]
    _, h = jax.jit(layers.GRU(5).apply)({"params": p["gru"]}, jnp.zeros((E, 5)), f, NEVER)
    np.testing.assert_allclose(y, h @ p["memory_out"]["kernel"], atol=1e-6)
    np.testing.assert_array_equal(gate, 1.0)


def test_a_policy_that_sees_refuses_to_walk_blind_and_a_blind_one_to_look(obs, params):
    with pytest.raises(ValueError, match="all variants but 'blind' take frames; this is 'full'"):
        actor().apply(params, START, obs, NEVER)
    blind = jax.jit(actor("blind").init)(jax.random.key(0), START, obs, NEVER)
    view = network.EncodedInput(
        network.zero_features(C, (48, 64), E), jnp.zeros((T, E), int), NEVER
    )
    with pytest.raises(ValueError, match="this is 'blind'"):
        actor("blind").apply(blind, START, obs, NEVER, view, method="decide")
