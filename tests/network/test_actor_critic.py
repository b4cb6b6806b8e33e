import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from jax.test_util import check_grads

from cref_jax import config, network
from cref_jax.network import layers, modules

T, E, OBS, J = 6, 4, 7, 3
SMALL = config.Network(variant="blind", token=8, lstm=10, gru=12, actor=(16, 8), critic=(16, 8))


ACTOR = network.Actor(SMALL, J)
run = jax.jit(ACTOR.apply)


@pytest.fixture(scope="module")
def obs():
    return jax.random.normal(jax.random.key(1), (T, E, OBS))


def untrained(obs):
    start = network.initial_carry(SMALL, E)
    return jax.jit(ACTOR.init)(jax.random.key(0), start, obs, jnp.zeros((T, E), bool))


@pytest.fixture(scope="module")
def params(obs):
    """Parameters whose biases and head are not near zero, so that every path matters."""
    params = untrained(obs)
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(7), len(leaves))
    shift = lambda key, leaf: leaf + 0.1 * jax.random.normal(key, leaf.shape)
    return jax.tree.unflatten(tree, map(shift, keys, leaves))


def random_carry(seed=3):
    leaves, tree = jax.tree.flatten(network.initial_carry(SMALL, E))
    keys = jax.random.split(jax.random.key(seed), len(leaves))
    draw = lambda key, leaf: jax.random.normal(key, leaf.shape)
    return jax.tree.unflatten(tree, map(draw, keys, leaves))


def some_begins():
    return jnp.zeros((T, E), bool).at[2, 0].set(True).at[0, 1].set(True).at[4, 2].set(True)


def side_by_side(cell_params, gates, leaf="kernel"):
    return jnp.concatenate([cell_params[gate][leaf] for gate in gates], axis=-1)


def test_lstm_agrees_with_flax():
    x = jax.random.normal(jax.random.key(0), (T, E, OBS))
    cell = nn.OptimizedLSTMCell(5, bias_init=nn.initializers.normal(1.0))
    memory = tuple(jax.random.normal(jax.random.key(i), (E, 5)) for i in (1, 2))
    theirs = jax.jit(cell.init)(jax.random.key(3), memory, x[0])["params"]
    ours = {
        "input": {
            "kernel": side_by_side(theirs, ("ii", "if", "ig", "io")),
            "bias": side_by_side(theirs, ("hi", "hf", "hg", "ho"), "bias"),
        },
        "recurrent": side_by_side(theirs, ("hi", "hf", "hg", "ho")),
    }
    last, hidden = jax.jit(layers.LSTM(5).apply)(
        {"params": ours}, memory, x, jnp.zeros((T, E), bool)
    )

    for t in range(T):
        memory, expected = jax.jit(cell.apply)({"params": theirs}, memory, x[t])
        np.testing.assert_allclose(hidden[t], expected, atol=1e-6)
    np.testing.assert_allclose(last[0], memory[0], atol=1e-6)
    np.testing.assert_allclose(last[1], memory[1], atol=1e-6)


def test_gru_agrees_with_flax():
    x = jax.random.normal(jax.random.key(0), (T, E, OBS))
    cell = nn.GRUCell(5, bias_init=nn.initializers.normal(1.0))
    memory = jax.random.normal(jax.random.key(1), (E, 5))
    theirs = jax.jit(cell.init)(jax.random.key(3), memory, x[0])["params"]
    ours = {
        "input": {
            "kernel": side_by_side(theirs, ("ir", "iz", "in")),
            "bias": side_by_side(theirs, ("ir", "iz", "in"), "bias"),
        },
        "recurrent": side_by_side(theirs, ("hr", "hz", "hn")),
        "candidate_bias": theirs["hn"]["bias"],
    }
    last, hidden = jax.jit(layers.GRU(5).apply)(
        {"params": ours}, memory, x, jnp.zeros((T, E), bool)
    )

    for t in range(T):
        memory, expected = jax.jit(cell.apply)({"params": theirs}, memory, x[t])
        np.testing.assert_allclose(hidden[t], expected, atol=1e-6)
    np.testing.assert_allclose(last, memory, atol=1e-6)


@pytest.mark.parametrize("cell", [layers.LSTM(5), layers.GRU(5)])
def test_gradients_through_a_cell_agree_with_finite_differences(cell):
    with jax.enable_x64(True):
        x = jax.random.normal(jax.random.key(0), (T, E, OBS))
        h = jax.random.normal(jax.random.key(1), (E, 5))
        memory = (h, 0.5 * h) if isinstance(cell, layers.LSTM) else h
        begins = some_begins()
        params = jax.jit(cell.init)(jax.random.key(2), memory, x, begins)
        params = jax.tree.map(lambda p: p.astype(jnp.float64), params)

        @jax.jit
        def loss(params, memory, x):
            last, hidden = cell.apply(params, memory, x, begins)
            return jnp.sum(hidden**2) + sum(jnp.sum(jnp.sin(m)) for m in jax.tree.leaves(last))

        check_grads(loss, (params, memory, x), order=1, modes=["rev"], rtol=1e-6)


def test_stepping_agrees_with_the_whole_sequence(params, obs):
    begins = some_begins()
    last, whole = run(params, random_carry(), obs, begins)

    carry = random_carry()
    for t in range(T):
        carry, step = run(params, carry, obs[t : t + 1], begins[t : t + 1])
        np.testing.assert_allclose(step.mean[0], whole.mean[t], atol=1e-5)
        np.testing.assert_allclose(step.velocity[0], whole.velocity[t], atol=1e-5)
        np.testing.assert_allclose(step.gate[0], whole.gate[t], atol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), carry, last)


def test_an_episode_start_forgets_everything_before_it(params, obs):
    begins = jnp.zeros((T, E), bool).at[4].set(True)
    _, whole = run(params, random_carry(), obs, begins)
    start = network.initial_carry(SMALL, E)
    _, fresh = run(params, start, obs[4:], jnp.zeros((2, E), bool))
    np.testing.assert_allclose(whole.mean[4:], fresh.mean, atol=1e-6)
    np.testing.assert_allclose(whole.velocity[4:], fresh.velocity, atol=1e-6)


def test_an_episode_start_forgets_even_what_is_not_finite(params, obs):
    begins = jnp.zeros((T, E), bool).at[0].set(True)
    broken = jax.tree.map(lambda m: jnp.full_like(m, jnp.nan), random_carry())

    def loss(params, carry):
        _, out = run(params, carry, obs, begins)
        return jnp.sum(out.mean**2) + jnp.sum(out.velocity**2)

    from_broken = jax.jit(jax.grad(loss))(params, broken)
    from_empty = jax.jit(jax.grad(loss))(params, network.initial_carry(SMALL, E))
    jax.tree.map(np.testing.assert_array_equal, from_broken, from_empty)


def test_no_gradient_crosses_an_episode_start(params, obs):
    begins = jnp.zeros((T, E), bool).at[4].set(True)

    def later(carry, obs):
        _, out = run(params, carry, obs, begins)
        return jnp.sum(out.mean[4:] ** 2) + jnp.sum(out.velocity[4:] ** 2)

    to_carry, to_obs = jax.jit(jax.grad(later, argnums=(0, 1)))(random_carry(), obs)
    assert all(not np.any(g) for g in jax.tree.leaves(to_carry))
    assert not np.any(to_obs[:4])
    assert np.all(np.any(to_obs[4:] != 0.0, axis=-1))


def test_memory_reaches_the_action_within_an_episode(params, obs):
    never = jnp.zeros((T, E), bool)
    at_the_end = lambda obs: jnp.sum(run(params, random_carry(), obs, never)[1].mean[-1])
    reach = jax.jit(jax.grad(at_the_end))(obs)
    assert np.all(np.any(reach != 0.0, axis=-1))


def test_environments_do_not_see_each_other(params, obs):
    one = lambda obs: jnp.sum(run(params, random_carry(), obs, some_begins())[1].mean[:, 1])
    reach = jax.jit(jax.grad(one))(obs)
    assert np.any(reach[:, 1]) and not np.any(np.delete(reach, 1, axis=1))


def test_the_policy_does_not_train_the_velocity_estimator(params, obs):
    def gradient(of):
        loss = lambda p: jnp.sum(of(run(p, random_carry(), obs, some_begins())[1]) ** 2)
        return jax.jit(jax.grad(loss))(params)["params"]

    moved = lambda grads, name: any(np.any(g) for g in jax.tree.leaves(grads[name]))
    by_action = gradient(lambda out: out.mean)
    by_velocity = gradient(lambda out: out.velocity)
    rest = ("proprioceptive_tokenizer", "fusion", "recurrent_fusion", "action_head")
    assert not moved(by_action, "velocity_estimator")
    assert all(moved(by_action, name) for name in rest)
    assert moved(by_velocity, "velocity_estimator")
    assert not any(moved(by_velocity, name) for name in rest)


def test_residual_fusion_worked_by_hand():
    # x = (1, 3): mean 2, variance 1, so LN(x) = (-1, 1) up to epsilon.
    # W1 = identity, b1 = 0: x~ = ELU(-1, 1) = (e^-1 - 1, 1) = (-0.632121, 1)
    # W2 takes x~ to c = 2 x~ and g = 0: f = x + 2 x~ / 2 = x + x~ = (0.367879, 4)
    eye = jnp.eye(2)
    params = {
        "norm": {"scale": jnp.ones(2), "bias": jnp.zeros(2)},
        "mix": {"kernel": eye, "bias": jnp.zeros(2)},
        "content_gate": {"kernel": jnp.hstack([2 * eye, 0 * eye]), "bias": jnp.zeros(4)},
    }
    f = modules.GatedResidualFusion().apply({"params": params}, jnp.array([[[1.0, 3.0]]]))
    np.testing.assert_allclose(f[0, 0], [0.367879, 4.0], atol=1e-5)


@pytest.mark.parametrize(("bias", "expected"), [(50.0, "memory"), (-50.0, "feature")])
def test_the_highway_gate_chooses_between_memory_and_feature(bias, expected):
    f = jax.random.normal(jax.random.key(0), (T, E, 3))
    fusion = modules.RecurrentFusion(5)
    begins = jnp.zeros((T, E), bool)
    start = jnp.zeros((E, 5))
    params = jax.jit(fusion.init)(jax.random.key(1), start, f, begins)["params"]
    params["gate"]["bias"] = jnp.full(3, bias)
    _, y, gate = jax.jit(fusion.apply)({"params": params}, start, f, begins)

    _, h = jax.jit(layers.GRU(5).apply)({"params": params["gru"]}, start, f, begins)
    sides = {"memory": h @ params["memory_out"]["kernel"], "feature": f}
    np.testing.assert_allclose(y, sides[expected], atol=1e-6)
    np.testing.assert_allclose(gate, 1.0 if bias > 0 else 0.0, atol=1e-6)


def test_the_first_actions_are_near_zero_and_as_wide_as_configured(obs):
    start = network.initial_carry(SMALL, E)
    _, out = run(untrained(obs), start, obs, jnp.zeros((T, E), bool))
    assert np.abs(out.mean).max() < 0.05
    np.testing.assert_allclose(np.exp(out.log_std), SMALL.initial_std, rtol=1e-6)


def test_shapes_and_names_are_those_that_the_export_relies_on(params, obs):
    carry, out = run(params, random_carry(), obs, some_begins())
    assert out.mean.shape == (T, E, J)
    assert out.log_std.shape == (J,)
    assert out.velocity.shape == (T, E, 3)
    assert out.gate.shape == (T, E, SMALL.token)
    assert jax.tree.map(jnp.shape, carry) == jax.tree.map(jnp.shape, random_carry())
    paths = {
        jax.tree_util.keystr(path, simple=True, separator="/")
        for path, _ in jax.tree_util.tree_leaves_with_path(params["params"])
    }
    dense = lambda *names: {f"{n}/{leaf}" for n in names for leaf in ("kernel", "bias")}
    assert paths == {
        "log_std",
        "fusion/norm/scale",
        "fusion/norm/bias",
        "velocity_estimator/lstm/recurrent",
        "recurrent_fusion/gru/recurrent",
        "recurrent_fusion/gru/candidate_bias",
        "recurrent_fusion/memory_out/kernel",
        *dense("velocity_estimator/lstm/input", "velocity_estimator/velocity"),
        *dense("proprioceptive_tokenizer/layer_0", "proprioceptive_tokenizer/layer_1"),
        *dense("fusion/mix", "fusion/content_gate"),
        *dense("recurrent_fusion/gru/input", "recurrent_fusion/gate"),
        *dense("action_head/layer_0", "action_head/layer_1", "action_head/layer_2"),
    }


def test_the_critic_judges_each_sample_alone():
    critic = network.Critic(SMALL)
    s = jax.random.normal(jax.random.key(0), (T, E, 9))
    params = jax.jit(critic.init)(jax.random.key(1), s)
    judge = jax.jit(critic.apply)
    value = judge(params, s)
    assert value.shape == (T, E)
    np.testing.assert_allclose(value[2:3, 1:2], judge(params, s[2:3, 1:2]), atol=1e-6)
