import dataclasses
import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo.losses import compute_gae
from jax.test_util import check_grads

from cref_jax import config, network, ppo
from cref_jax.ppo import auxiliary, gaussian, losses

T, E, OBS, CRITIC_OBS, J = 5, 8, 4, 6, 2
C = config.PPO(epochs=2, minibatches=2)
SMALL = config.Network(variant="blind", token=6, lstm=5, gru=7, actor=(8,), critic=(8,))
FEATURES = 6  # of a blind policy: as many as of a token
KEY = jax.random.key(0)
NETWORKS = ppo.Networks(network.Actor(SMALL, J).apply, network.Critic(SMALL).apply)


def column(*values):
    return jnp.array(values)[:, None]


@partial(jax.jit, static_argnums=0)
def initial_params(seed=0):
    carry, no = network.initial_carry(SMALL, 1), jnp.zeros((1, 1), bool)
    key_actor, key_critic = jax.random.split(jax.random.key(seed))
    params = ppo.Params(
        network.Actor(SMALL, J).init(key_actor, carry, jnp.zeros((1, 1, OBS)), no),
        network.Critic(SMALL).init(key_critic, jnp.zeros((1, 1, CRITIC_OBS))),
    )
    # larger last layers, so that a step changes something that float32 can see
    return jax.tree.map(lambda p: 1.5 * p, params)


@partial(jax.jit, static_argnums=0)
def some_rollout(seed=1):
    """A rollout of random numbers, its distribution and values from the policy itself."""
    params = initial_params()
    keys = iter(jax.random.split(jax.random.key(seed), 12))
    normal = lambda *shape: jax.random.normal(next(keys), shape)
    obs, critic_obs = normal(T, E, OBS), normal(T, E, CRITIC_OBS)
    begins = jax.random.bernoulli(next(keys), 0.2, (T, E))
    carry = jax.tree.map(lambda m: normal(*m.shape), network.initial_carry(SMALL, E))
    _, policy = NETWORKS.actor(params.actor, carry, obs, begins, None)
    value = NETWORKS.critic(params.critic, critic_obs)
    return ppo.Rollout(
        obs=obs,
        critic_obs=critic_obs,
        velocity=normal(T, E, 3),
        action=policy.mean + jnp.exp(policy.log_std) * normal(T, E, J),
        mean=policy.mean,
        log_std=jnp.broadcast_to(policy.log_std, policy.mean.shape),
        reward=normal(T, E),
        value=value,
        next_value=normal(T, E),
        terminated=jax.random.bernoulli(next(keys), 0.2, (T, E)),
        truncated=jnp.zeros((T, E), bool),
        begins=begins,
        valid=jnp.ones((T, E), bool),
        carry=carry,
    )


@partial(jax.jit, static_argnums=0)
def initial_state(c=C):
    return ppo.initial_state(initial_params(), OBS, CRITIC_OBS, c)


judge = jax.jit(lambda rollout: ppo.prepare_batch(initial_state().statistics, rollout, C))


@jax.jit
def update(state, rollout, key):
    return ppo.update(state, rollout, key, C, NETWORKS)


def assert_same(a, b, **tolerance):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, **tolerance)


def test_gae_worked_by_hand():
    # rewards 1,2,3; values .5,1,1.5; bootstrap 2; gamma .5, lambda .5; no episode ends
    # d2 = 3+1-1.5 = 2.5 ; d1 = 2+.75-1 = 1.75 ; d0 = 1+.5-.5 = 1
    # A2 = 2.5 ; A1 = 1.75+.25*2.5 = 2.375 ; A0 = 1+.25*2.375 = 1.59375
    never = jnp.zeros((3, 1), bool)
    reward, value, following = column(1.0, 2.0, 3.0), column(0.5, 1.0, 1.5), column(1.0, 1.5, 2.0)
    advantage = ppo.gae(reward, value, following, never, never, 0.5, 0.5)
    np.testing.assert_allclose(advantage[:, 0], [1.59375, 2.375, 2.5])


def test_falling_cuts_the_bootstrap_and_timeout_does_not():
    # As above, but the episode ends with step 1, in a state worth 4; gamma .5, lambda .5.
    # Fallen: d1 = 2-1 = 1 ;     A1 = 1 ; A0 = 1+.25*1 = 1.25
    # Timeout: d1 = 2+.5*4-1 = 3 ; A1 = 3 ; A0 = 1+.25*3 = 1.75
    # A2 belongs to the next episode and stays 2.5.
    never, then = jnp.zeros((3, 1), bool), column(False, True, False)
    reward, value, following = column(1.0, 2.0, 3.0), column(0.5, 1.0, 1.5), column(1.0, 4.0, 2.0)
    fallen = ppo.gae(reward, value, following, then, never, 0.5, 0.5)
    timeout = ppo.gae(reward, value, following, never, then, 0.5, 0.5)
    np.testing.assert_allclose(fallen[:, 0], [1.25, 1.0, 2.5])
    np.testing.assert_allclose(timeout[:, 0], [1.75, 3.0, 2.5])


def test_gae_agrees_with_brax_where_nothing_is_truncated():
    r = some_rollout()
    # brax reads the next value from the next row
    following = jnp.concatenate([r.value[1:], r.next_value[-1:]])
    ours = ppo.gae(r.reward, r.value, following, r.terminated, r.truncated, 0.9, 0.8)
    zero = jnp.zeros((T, E))
    ends = r.terminated.astype(float)
    targets, _ = compute_gae(zero, ends, r.reward, r.value, following[-1], 0.8, 0.9)
    np.testing.assert_allclose(ours, targets - r.value, atol=1e-5)


def test_gae_agrees_with_brax_around_a_truncation():
    # brax gives a truncated step no advantage at all and cuts the trace there; ours lets the step
    # bootstrap. With a reward of V(s) - gamma V(s') in that step the two must agree.
    r = some_rollout()
    truncated = jnp.zeros((T, E), bool).at[2].set(True)
    following = jnp.concatenate([r.value[1:], r.next_value[-1:]])
    reward = r.reward.at[2].set(r.value[2] - 0.9 * following[2])
    never = jnp.zeros((T, E), bool)
    ours = ppo.gae(reward, r.value, following, never, truncated, 0.9, 0.8)
    cut, zero = truncated.astype(float), jnp.zeros((T, E))
    targets, _ = compute_gae(cut, zero, reward, r.value, following[-1], 0.8, 0.9)
    np.testing.assert_allclose(ours, targets - r.value, atol=1e-5)


def test_surrogate_worked_by_hand():
    # clip .2. Gain: A = 2: r 1.5 -> 1.2*2 = 2.4 ; r .5 -> .5*2 = 1 ; r 1.1 -> 2.2
    # Loss: A = -2: r 1.5 -> min(-3, -2.4) = -3 ; r .5 -> min(-1, -1.6) = -1.6 ; r 1.1 -> -2.2
    ratio = jnp.array([[1.5, 0.5, 1.1, 1.5, 0.5, 1.1]])
    advantage = jnp.array([[2.0, 2.0, 2.0, -2.0, -2.0, -2.0]])
    out = losses.surrogate_loss(ratio, advantage, 0.2)
    np.testing.assert_allclose(out[0], [-2.4, -1.0, -2.2, 3.0, 1.6, 2.2], rtol=1e-6)
    slope = jax.grad(lambda r: losses.surrogate_loss(r, advantage, 0.2).sum())(ratio)
    np.testing.assert_allclose(slope[0], [0.0, -2.0, -2.0, 2.0, 0.0, 2.0])


def test_value_error_worked_by_hand():
    # old 1, clip .2. V 1.1, target 2: (.9)^2 = .81, inside the clip range
    # V 2, target 2: free 0, held 1.2: .64 ; V 3, target 1: free 4, held 1.2: .04
    value, target = jnp.array([[1.1, 2.0, 3.0]]), jnp.array([[2.0, 2.0, 1.0]])
    out = losses.value_error(value, jnp.ones((1, 3)), target, 0.2)
    np.testing.assert_allclose(out[0], [0.81, 0.64, 4.0], rtol=1e-5)


def test_log_prob_and_entropy_worked_by_hand():
    # x = (1, 0), m = (0, 0), s = (1, 2): -(1/2 + ln 1 + .918939) - (0 + ln 2 + .918939) = -3.031024
    # entropy: ln 1 + ln 2 + 2 * 1.418939 = 3.531024
    mean, log_std = jnp.zeros((1, 2)), jnp.log(jnp.array([1.0, 2.0]))
    out = gaussian.log_prob(jnp.array([[1.0, 0.0]]), mean, log_std)
    np.testing.assert_allclose(out, [-3.031024], rtol=1e-6)
    np.testing.assert_allclose(gaussian.entropy(log_std), 3.531024, rtol=1e-6)


def test_kl_worked_by_hand():
    # old (0, s 1), new (1, s 2): ln 2 + (1 + 1)/8 - 1/2 = .443147
    # old (1, s 2), new (1, s 2): 0.  The divergence of the pair is their sum.
    old_mean, old_log_std = jnp.array([[0.0, 1.0]]), jnp.log(jnp.array([[1.0, 2.0]]))
    out = gaussian.kl(old_mean, old_log_std, jnp.ones((1, 2)), jnp.log(jnp.array([2.0, 2.0])))
    np.testing.assert_allclose(out, [0.443147], rtol=1e-5)


def test_kl_and_entropy_agree_with_sampling():
    mean, log_std = jnp.array([0.3, -1.0]), jnp.array([-0.5, 0.4])
    other, other_log_std = jnp.array([0.0, -0.5]), jnp.array([-0.2, 0.1])
    x = mean + jnp.exp(log_std) * jax.random.normal(jax.random.key(0), (200_000, 2))
    p = gaussian.log_prob(x, jnp.broadcast_to(mean, x.shape), log_std)
    q = gaussian.log_prob(x, jnp.broadcast_to(other, x.shape), other_log_std)
    exact = gaussian.kl(mean[None], log_std[None], other[None], other_log_std)[0]
    np.testing.assert_allclose(jnp.mean(p - q), exact, atol=0.01)
    np.testing.assert_allclose(-jnp.mean(p), gaussian.entropy(log_std), atol=0.01)


class OneStep(NamedTuple):
    mean: jax.Array
    log_std: jax.Array
    velocity: jax.Array


def test_the_loss_worked_by_hand():
    # One sample, one action. Behaviour N(0, 1), now N(m, 1) with m = .1, action 1:
    # log ratio = (1 - .81)/2 = .095, ratio 1.099659, advantage 2 -> surrogate -2.199318
    # V = 1.1, old 1, return 2: .81.  velocity (1, 2, 0) against 0: 5.  entropy 1.418939
    # KL = .01/2 = .005
    # total = -2.199318 + 1*.81 + 1*5 - .005*1.418939 = 3.603588
    one = lambda x: jnp.full((1, 1), x)
    batch = ppo.Batch(
        obs=jnp.zeros((1, 1, 1)),
        critic_obs=jnp.zeros((1, 1, 1)),
        velocity=jnp.zeros((1, 1, 3)),
        action=jnp.ones((1, 1, 1)),
        mean=jnp.zeros((1, 1, 1)),
        log_std=jnp.zeros((1, 1, 1)),
        value=one(1.0),
        advantage=one(2.0),
        returns=one(2.0),
        begins=one(False),
        valid=one(True),
        carry=(),
    )
    said = lambda m: OneStep(m[None, None, None], jnp.zeros(1), jnp.array([[[1.0, 2.0, 0.0]]]))
    networks = ppo.Networks(
        lambda m, carry, obs, begins, sight: (carry, said(m)), lambda v, s: one(v)
    )
    params = ppo.Params(jnp.array(0.1), jnp.array(1.1))
    total, parts = losses.loss(params, batch, config.PPO(), networks)
    np.testing.assert_allclose(total, 3.603588, rtol=1e-6)
    expected = {
        "surrogate": -2.199318,
        "value": 0.81,
        "velocity": 5.0,
        "readout": 0.0,
        "asymmetry": 0.0,
        "teacher_kl": 0.0,
        "entropy": 1.418939,
        "kl": 0.005,
        "clipped": 0.0,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(parts, name), value, rtol=1e-5, err_msg=name)


def mirrored_toy():
    """An actor that says W o + b, and a mirror that turns over the sign of all things."""

    class Said(NamedTuple):
        mean: jax.Array
        log_std: jax.Array
        velocity: jax.Array
        feature: None = None

    def actor(p, carry, obs, begins, sight):
        return carry, Said(obs @ p["w"] + p["b"], jnp.zeros(J), jnp.zeros((*obs.shape[:2], 3)))

    turned = lambda x: -x
    mirror = ppo.Mirror(obs=turned, frames=turned, sight=lambda sight: sight, action=turned)
    networks = NETWORKS._replace(actor=actor, mirror=mirror)
    params = {"w": jax.random.normal(KEY, (OBS, J)), "b": jnp.array([0.3, -0.1])}
    return networks, initial_params()._replace(actor=params)


def test_asymmetry_is_what_the_mirrored_policy_does_otherwise():
    # W o + b - M(W (M o) + b) = W o + b + (-W o + b) = 2 b; the mean of (0.6^2, 0.2^2) is 0.2
    networks, params = mirrored_toy()
    batch = judge(some_rollout())
    batch = batch._replace(twin_obs=-batch.obs, twin=())
    _, said = networks.actor(params.actor, (), batch.obs, None, None)
    found = losses.asymmetry_error(params.actor, batch, said.mean, networks.actor, networks.mirror)
    np.testing.assert_allclose(found, 0.2, rtol=1e-5)
    c = dataclasses.replace(C, mirror_weight=3.0)
    with_it, parts = losses.loss(params, batch, c, networks)
    without, _ = losses.loss(params, batch, C, networks)
    np.testing.assert_allclose(with_it - without, 3.0 * 0.2, rtol=1e-4)
    np.testing.assert_allclose(parts.asymmetry, 0.2, rtol=1e-5)


def test_an_update_makes_the_policy_more_symmetric():
    # nothing to gain anywhere, so that the mirror alone decides: b shrinks and W stays
    networks, params = mirrored_toy()
    c = dataclasses.replace(C, mirror_weight=1.0, entropy_weight=0.0, learning_rate=0.01)
    rollout = some_rollout()._replace(twin=())
    rollout = rollout._replace(mean=rollout.obs @ params.actor["w"] + params.actor["b"])
    rollout = rollout._replace(
        action=rollout.mean, reward=jnp.zeros((T, E)), value=jnp.zeros((T, E))
    )
    rollout = rollout._replace(next_value=jnp.zeros((T, E)), log_std=jnp.zeros((T, E, J)))
    state = ppo.initial_state(params, OBS, CRITIC_OBS, c)
    after, losses = ppo.update(state, rollout, KEY, c, networks)
    assert losses.asymmetry[0, 0] == pytest.approx(0.2, rel=1e-4)
    before, now = params.actor, after.params.actor
    assert (jnp.abs(now["b"]) < jnp.abs(before["b"])).all()
    np.testing.assert_allclose(now["w"], before["w"], atol=1e-6)


def test_a_teacher_two_deviations_away_costs_two_nats_whatever_the_deviation_does():
    # W o + b of the toy and a teacher 2 s beside it in the second joint: (2 s)^2 / (2 s^2) = 2
    networks, params = mirrored_toy()
    networks = networks._replace(mirror=None)
    batch = judge(some_rollout())
    _, said = networks.actor(params.actor, (), batch.obs, None, None)
    batch = batch._replace(target=said.mean + jnp.array([0.0, 2.0]))  # s = exp(0)
    c = dataclasses.replace(C, imitation_weight=3.0)
    with_it, parts = losses.loss(params, batch, c, networks)
    without, _ = losses.loss(params, batch, C, networks)
    np.testing.assert_allclose(parts.teacher_kl, 2.0, rtol=1e-5)
    np.testing.assert_allclose(with_it - without, 3.0 * 2.0, rtol=1e-4)


def test_who_has_no_teacher_is_not_drawn_anywhere():
    # half of the samples have a teacher 2 s beside them, as above, and the mean is half as much
    networks, params = mirrored_toy()
    networks = networks._replace(mirror=None)
    batch = judge(some_rollout())
    _, said = networks.actor(params.actor, (), batch.obs, None, None)
    alone = (jnp.arange(E) % 2 == 0)[:, None]
    beside = said.mean + jnp.array([0.0, 2.0])
    c = dataclasses.replace(C, imitation_weight=3.0)
    batch = batch._replace(target=jnp.where(alone, jnp.nan, beside))
    _, parts = losses.loss(params, batch, c, networks)
    np.testing.assert_allclose(parts.teacher_kl, 1.0, rtol=1e-5)
    batch = batch._replace(target=jnp.full_like(beside, jnp.nan))
    pull = jax.grad(lambda p, c: losses.loss(p, batch, c, networks)[0])
    jax.tree.map(np.testing.assert_array_equal, pull(params, c), pull(params, C))


def test_the_readout_is_judged_by_the_last_of_what_the_critic_sees():
    batch = judge(some_rollout())
    params = initial_params()
    silent = auxiliary.initial_readout(FEATURES, 2)
    says = silent._replace(bias=jnp.array([1.0, -2.0]))
    c = dataclasses.replace(C, readout_weight=0.5)
    without, parts = losses.loss(params, batch, c, NETWORKS)
    assert parts.readout == 0.0
    total, parts = losses.loss(params._replace(readout=says), batch, c, NETWORKS)
    wanted = np.mean((batch.critic_obs[..., -2:] - np.array([1.0, -2.0])) ** 2)
    np.testing.assert_allclose(parts.readout, wanted, rtol=1e-5)
    np.testing.assert_allclose(total - without, 0.5 * wanted, rtol=1e-4)


def test_the_readout_teaches_the_actors_features():
    batch = judge(some_rollout())
    kernel = jax.random.normal(KEY, (FEATURES, 2))
    params = initial_params()._replace(readout=auxiliary.Readout(kernel, jnp.zeros(2)))

    def slope(weight):
        c = dataclasses.replace(C, readout_weight=weight)
        return jax.grad(lambda p: losses.loss(p, batch, c, NETWORKS)[0])(params).actor["params"]

    changes = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), slope(1.0), slope(0.0))
    largest = {name: max(jax.tree.leaves(part)) for name, part in changes.items()}
    for name in ("recurrent_fusion", "fusion", "proprioceptive_tokenizer"):
        assert largest[name] > 1e-4, name
    for name in ("action_head", "log_std", "velocity_estimator"):
        assert largest[name] < 1e-6, name


def test_the_gradient_of_the_loss_agrees_with_finite_differences():
    with jax.enable_x64(True):
        wide = lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x
        params = jax.tree.map(wide, initial_params())
        batch = jax.tree.map(wide, judge(some_rollout()))
        # the estimator trains on its own loss alone, so the actor is checked without it
        actor = params.actor["params"]

        @jax.jit
        def loss(rest, critic):
            moved = ppo.Params({"params": {**actor, **rest}}, critic)
            return losses.loss(moved, batch, C, NETWORKS)[0]

        rest = {k: 1.01 * v for k, v in actor.items() if k == "log_std"} | {
            k: v for k, v in actor.items() if k not in ("velocity_estimator", "log_std")
        }
        check_grads(loss, (rest, params.critic), order=1, modes=["rev"], rtol=1e-5)


def test_ratio_and_kl_of_the_first_minibatch_say_that_nothing_has_moved():
    _, losses = update(initial_state(), some_rollout(), KEY)
    assert losses.kl.shape == (C.epochs, C.minibatches)
    np.testing.assert_allclose(losses.kl[0, 0], 0.0, atol=1e-6)
    assert losses.kl[-1, -1] > 1e-5


def test_advantages_are_normalised_over_the_whole_batch():
    batch = judge(some_rollout())
    np.testing.assert_allclose(batch.advantage.mean(), 0.0, atol=1e-6)
    np.testing.assert_allclose(batch.advantage.std(), 1.0, rtol=1e-5)
    assert abs(float(batch.advantage[:, 0].mean())) > 1e-3


def test_minibatches_never_mix_time_or_environments():
    batch = judge(some_rollout())
    mark = jnp.arange(T)[:, None] + 100.0 * jnp.arange(E)[None]
    batch = batch._replace(
        value=mark,
        obs=jnp.repeat(mark[..., None], OBS, axis=-1),
        carry=jax.tree.map(
            lambda m: jnp.broadcast_to(100.0 * jnp.arange(E)[:, None], m.shape), batch.carry
        ),
    )
    split = ppo.minibatches(batch, jax.random.key(0), 2)
    assert split.value.shape == (2, T, E // 2)
    # each column is one environment through all of time
    step, env = split.value % 100, split.value // 100
    assert np.all(step == np.arange(T)[None, :, None])
    assert np.all(env == env[:, :1])
    # every environment comes exactly once, and all records keep together
    assert sorted(split.value[:, 0].ravel()) == list(100.0 * np.arange(E))
    np.testing.assert_array_equal(split.obs[..., 0], split.value)
    np.testing.assert_array_equal(split.carry.gru[..., 0], split.value[:, 0])


def test_minibatches_differ_from_epoch_to_epoch_and_refuse_a_remainder():
    batch = judge(some_rollout())
    a, b = (ppo.minibatches(batch, jax.random.key(seed), 2).value for seed in (0, 1))
    assert np.any(a != b)
    with pytest.raises(ValueError, match="8 environments do not split into 3"):
        ppo.minibatches(batch, jax.random.key(0), 3)


def test_invalid_samples_change_nothing():
    # Two rollouts that differ only in two broken steps must teach exactly the same.
    broken = jnp.zeros((T, E), bool).at[2, 3].set(True).at[T - 1, 5].set(True)
    sound = some_rollout()
    begins = sound.begins | jnp.roll(broken, 1, axis=0).at[0].set(False)
    sound = sound._replace(valid=~broken, begins=begins)

    def ruin(x):
        if x.dtype == bool:
            return x
        return jnp.where(broken.reshape(T, E, *[1] * (x.ndim - 2)), jnp.nan, x)

    ruined = jax.tree.map(ruin, sound._replace(carry=()))._replace(carry=sound.carry)
    assert not np.isfinite(ruined.obs).all()
    state = initial_state()
    after_sound, losses_sound = update(state, sound, jax.random.key(0))
    after_ruined, losses_ruined = update(state, ruined, jax.random.key(0))
    assert_same((after_sound, losses_sound), (after_ruined, losses_ruined), rtol=0.0)
    assert np.isfinite(losses_ruined.gradient_norm).all() and not losses_ruined.skipped.any()


def test_an_invalid_step_ends_the_horizon_of_those_before_it():
    sound = some_rollout()._replace(terminated=jnp.zeros((T, E), bool))
    broken = sound._replace(valid=sound.valid.at[3].set(False))
    first = jax.tree.map(lambda x: x[:3], sound._replace(carry=()))._replace(carry=sound.carry)
    # returns, since advantages are normalised over other samples
    whole, part = judge(broken), judge(first)
    np.testing.assert_allclose(whole.returns[:3], part.returns, atol=1e-6)


def test_a_rollout_without_a_valid_sample_leaves_finite_numbers():
    nothing = some_rollout()._replace(valid=jnp.zeros((T, E), bool))
    state, losses = update(initial_state(), nothing, jax.random.key(0))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((state, losses)))


def test_a_gradient_that_is_not_finite_is_skipped_and_counted():
    state = initial_state()
    bad = jax.tree.map(lambda p: jnp.full_like(p, jnp.nan), state.params)
    bad = state.params._replace(critic=bad.critic)
    opt = ppo.optimizer(C)
    changes, after = jax.jit(opt.update)(bad, state.opt_state, state.params)
    assert not any(np.any(x) for x in jax.tree.leaves(changes))
    assert int(after.total_notfinite) == 1 and int(after.notfinite_count) == 1
    assert_same(after.inner_state, state.opt_state.inner_state)


def test_an_update_of_bad_gradients_changes_no_parameter():
    # a valid sample whose reward overflows the value loss
    rollout = some_rollout()._replace(reward=jnp.full((T, E), 3e38))
    state, losses = update(initial_state(), rollout, KEY)
    assert losses.skipped.all()
    assert int(state.opt_state.total_notfinite) == C.epochs * C.minibatches
    assert int(state.opt_state.notfinite_count) == C.epochs * C.minibatches
    assert_same(state.params, initial_params())


@pytest.mark.parametrize(
    ("rate", "kl", "expected"),
    [
        (1e-3, 0.021, 1e-3 / 1.5),  # above 2 x 0.01
        (1e-3, 0.020, 1e-3),
        (1e-3, 0.010, 1e-3),
        (1e-3, 0.005, 1e-3),
        (1e-3, 0.004, 1.5e-3),  # below 0.01 / 2
        (1e-3, 0.0, 1e-3),  # nothing has moved
        (1e-3, math.nan, 1e-3),
        (1e-5, 0.1, 1e-5),  # the ends of the range
        (9e-3, 0.001, 1e-2),
    ],
)
def test_learning_rate_adaptation_worked_by_hand(rate, kl, expected):
    out = ppo.adapt_learning_rate(jnp.array(rate), jnp.array(kl), config.PPO())
    np.testing.assert_allclose(out, expected, rtol=1e-6)


def test_the_learning_rate_is_part_of_the_state_and_goes_on_from_there():
    state, losses = update(initial_state(), some_rollout(), jax.random.key(0))
    rates = losses.learning_rate.ravel()
    kls = losses.kl.ravel()
    rate = C.learning_rate
    for i in range(rates.size):
        rate = float(ppo.adapt_learning_rate(jnp.array(rate), kls[i], C))
        np.testing.assert_allclose(rates[i], rate, rtol=1e-5)
    assert rate != C.learning_rate
    _, again = update(state, some_rollout(), jax.random.key(1))
    held = float(ppo.adapt_learning_rate(rates[-1], again.kl[0, 0], C))
    np.testing.assert_allclose(again.learning_rate[0, 0], held, rtol=1e-6)


def test_the_learning_rate_scales_the_step():
    # Adam's first step is the rate times the sign of each gradient
    one = config.PPO(epochs=1, minibatches=1, learning_rate=1e-4)
    state = initial_state(one)
    learn = jax.jit(lambda state: ppo.update(state, some_rollout(), KEY, one, NETWORKS))
    after, losses = learn(state)
    moved = jax.tree.map(lambda a, b: jnp.abs(a - b).max(), after.params, state.params)
    largest = max(float(m) for m in jax.tree.leaves(moved))
    np.testing.assert_allclose(largest, losses.learning_rate[0, 0], rtol=1e-2)


def test_the_critic_alone_learns_first_and_the_actor_begins_at_the_lowest_rate():
    c = dataclasses.replace(C, critic_first=2)
    state = ppo.initial_state(initial_params(), OBS, CRITIC_OBS, c)
    after = [state]
    for _ in range(3):
        state, losses = ppo.update(state, some_rollout(), KEY, c, NETWORKS)
        after.append(state)
        if len(after) < 4:
            np.testing.assert_allclose(losses.learning_rate, c.learning_rate)
    np.testing.assert_allclose(losses.learning_rate, c.learning_rate_range[0])
    same = lambda a, b: all(
        np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )
    actors, critics = [s.params.actor for s in after], [s.params.critic for s in after]
    assert same(actors[0], actors[1]) and same(actors[1], actors[2])
    assert not same(actors[2], actors[3])
    assert not same(critics[0], critics[1]) and not same(critics[1], critics[2])


def test_a_critic_with_a_rate_of_its_own_takes_steps_of_it_and_the_actor_none_other():
    one = dataclasses.replace(C, epochs=1, minibatches=1)
    state = ppo.initial_state(initial_params(), OBS, CRITIC_OBS, one)
    moved = {}
    for own in (0.0, 1e-5):
        c = dataclasses.replace(one, critic_learning_rate=own)
        after, losses = ppo.update(state, some_rollout(), KEY, c, NETWORKS)
        largest = lambda a, b: max(
            float(jnp.abs(x - y).max())
            for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
        )
        moved[own] = largest(after.params.critic, state.params.critic)
        # Adam's first step is the rate itself
        actors = largest(after.params.actor, state.params.actor)
        np.testing.assert_allclose(actors, losses.learning_rate[0, 0], rtol=1e-2)
    np.testing.assert_allclose([moved[0.0], moved[1e-5]], [C.learning_rate, 1e-5], rtol=1e-2)


def test_the_actor_waits_for_the_critic_though_its_optimiser_has_momentum():
    moving, _ = update(initial_state(), some_rollout(), KEY)
    c = dataclasses.replace(C, critic_first=2)
    still, _ = ppo.update(moving.replace(iteration=jnp.array(1)), some_rollout(), KEY, c, NETWORKS)
    jax.tree.map(np.testing.assert_array_equal, still.params.actor, moving.params.actor)


@pytest.mark.parametrize(("iteration", "share"), [(0, 1.0), (30, 1 / 4), (10**6, 1 / 201)])
def test_the_average_fades_over_a_tenth_of_all_iterations_up_to_a_limit(iteration, share):
    before = initial_state().replace(iteration=jnp.array(iteration))
    before = before.replace(average=jax.tree.map(jnp.zeros_like, before.average))
    after, _ = update(before, some_rollout(), KEY)
    expected = jax.tree.map(lambda p: share * p, after.params.actor)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), after.average, expected)


def test_statistics_are_those_of_all_valid_samples():
    valid = jax.random.bernoulli(jax.random.key(5), 0.7, (T, E))
    first, second = some_rollout(1)._replace(valid=valid), some_rollout(2)
    state, _ = update(initial_state(), first, jax.random.key(0))
    state, _ = update(state, second, jax.random.key(0))
    seen = np.concatenate([first.obs[valid], second.obs.reshape(-1, OBS)])
    np.testing.assert_allclose(state.statistics.obs.mean, seen.mean(0), atol=1e-5)
    np.testing.assert_allclose(state.statistics.obs.std, np.sqrt(seen.var(0) + 1e-4), rtol=1e-4)
    assert int(state.iteration) == 2


def test_normalisation_is_bounded_and_undoes_scale():
    statistics = initial_state().statistics.obs
    x = 5.0 + 2.0 * jax.random.normal(jax.random.key(0), (400, 50, OBS))
    statistics = ppo.update_statistics(statistics, x, jnp.ones((400, 50), bool))
    out = ppo.normalize(statistics, x)
    np.testing.assert_allclose(out.mean((0, 1)), 0.0, atol=1e-3)
    np.testing.assert_allclose(out.std((0, 1)), 1.0, rtol=1e-3)
    assert float(ppo.normalize(statistics, jnp.full((1, OBS), 1e9)).max()) == ppo.OBSERVATION_CLIP


def test_devices_that_share_the_robots_learn_what_one_would():
    # one minibatch, since each device draws its own; invalid samples, as many as chance has it
    one = dataclasses.replace(C, epochs=2, minibatches=1)
    whole = some_rollout()
    valid = jax.random.bernoulli(jax.random.key(5), 0.7, (T, E)).at[:, : E // 2].set(True)
    whole = whole._replace(valid=valid)
    halves = jax.tree.map(lambda x: jnp.stack(jnp.split(x, 2, axis=1), 0), whole._replace(carry=()))
    carry = jax.tree.map(lambda x: jnp.stack(jnp.split(x, 2)), whole.carry)
    learn = lambda rollout: ppo.update(
        initial_state(), rollout, jax.random.key(0), one, NETWORKS, "devices"
    )
    shared = jax.jit(jax.vmap(learn, axis_name="devices"))(halves._replace(carry=carry))
    alone = jax.jit(ppo.update, static_argnums=(3, 4))(
        initial_state(), whole, jax.random.key(0), one, NETWORKS
    )
    for device in range(2):
        mine = jax.tree.map(lambda x, device=device: x[device], shared)
        assert_same(mine, alone, rtol=2e-4, atol=2e-5)


def test_an_update_runs_inside_a_scan():
    def iteration(state, key):
        return ppo.update(state, some_rollout(), key, C, NETWORKS)

    keys = jax.random.split(jax.random.key(0), 3)
    state, losses = jax.jit(lambda s: jax.lax.scan(iteration, s, keys))(initial_state())
    assert int(state.iteration) == 3
    assert losses.kl.shape == (3, C.epochs, C.minibatches)

    one_by_one = initial_state()
    for key in keys:
        one_by_one, _ = update(one_by_one, some_rollout(), key)
    assert_same(one_by_one.params, state.params, atol=1e-5)


def test_an_update_compiles_once():
    # a weak type or another dtype in the state that comes out would compile everything again
    learn = jax.jit(lambda state, key: ppo.update(state, some_rollout(), key, C, NETWORKS)[0])
    state = learn(initial_state(), jax.random.key(0))
    learn(state, jax.random.key(1))
    assert learn._cache_size() == 1


def test_the_shape_of_a_state_can_be_asked_for_without_one():
    shape = jax.eval_shape(initial_state)
    assert jax.tree.structure(shape) == jax.tree.structure(initial_state())

    seeds = jax.vmap(lambda state: state.replace(iteration=state.iteration + 1))(
        jax.tree.map(lambda x: jnp.stack([x, x]), initial_state())
    )
    assert seeds.iteration.tolist() == [1, 1]
