"""PPO on problems whose answers are known, each harder by one thing than the one before."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import toy_problems

from cref_jax import config

pytestmark = pytest.mark.slow

C = config.PPO(
    horizon=24, epochs=4, minibatches=2, entropy_weight=0.0, value_clip=1e9, learning_rate=3e-3
)
BLIND = lambda step, cue: jnp.zeros(1)


def test_a_constant_reward_is_worth_itself():
    # one step, reward 1 whatever happens: V = 1
    toy = toy_problems.Toy(length=1, observe=BLIND, reward=lambda step, cue, action: jnp.array(1.0))
    outcome = toy_problems.solve(toy, C, iterations=60)
    np.testing.assert_allclose(outcome.value, 1.0, atol=0.02)


def test_a_constant_reward_is_worth_its_discounted_sum():
    # 8 steps of reward 1 at gamma .9: V_t = (1 - .9^(8 - t)) / .1, from 5.695 down to 1
    toy = toy_problems.Toy(length=8, observe=BLIND, reward=lambda step, cue, action: jnp.array(1.0))
    outcome = toy_problems.solve(toy, replace(C, gamma=0.9), iterations=150)
    expected = (1.0 - 0.9 ** (8 - np.arange(8))) / 0.1
    np.testing.assert_allclose(outcome.value[:, 0], expected, atol=0.15)


def test_the_action_that_pays_best_is_found():
    # reward 1 - (a - .7)^2: the best action is .7
    toy = toy_problems.Toy(1, BLIND, lambda step, cue, action: 1.0 - (action - 0.7) ** 2)
    outcome = toy_problems.solve(toy, C, iterations=100)
    np.testing.assert_allclose(outcome.mean_action, 0.7, atol=0.05)


def test_the_action_follows_the_observation():
    # reward 1 - (a - cue)^2 with the cue in sight: the best action is the cue
    toy = toy_problems.Toy(
        1, lambda step, cue: cue[None], lambda step, cue, action: 1.0 - (action - cue) ** 2
    )
    outcome = toy_problems.solve(toy, C, iterations=150)
    np.testing.assert_allclose(outcome.mean_action, [[-1.0, 1.0]], atol=0.08)


@pytest.mark.parametrize(("gamma", "best"), [(0.5, 0.5), (0.25, 1.5)])
def test_credit_reaches_the_step_that_earned_it(gamma, best):
    # Step 0 pays a at once and costs (a + .5)^2 one step later:
    # Q(a) = a - gamma (a + .5)^2, dQ/da = 1 - 2 gamma (a + .5) = 0 at a = 1/(2 gamma) - .5.
    # gamma .5: a = .5, V_0 = .5 - .5 * 1 = 0 ; gamma .25: a = 1.5, V_0 = 1.5 - .25 * 4 = .5
    toy = toy_problems.Toy(
        length=2,
        observe=BLIND,
        reward=lambda step, cue, action: jnp.where(step == 0, action, -((cue + 0.5) ** 2)),
        advance=lambda step, cue, action: action,
    )
    outcome = toy_problems.solve(toy, replace(C, gamma=gamma), iterations=250)
    np.testing.assert_allclose(outcome.mean_action[0], best, atol=0.15)
    np.testing.assert_allclose(outcome.value[0], best - gamma * (best + 0.5) ** 2, atol=0.1)


# The cue is in sight in step 0 alone; only the last step is paid: 1 - (a - cue)^2.
RECALL = toy_problems.Toy(
    length=6,
    observe=lambda step, cue: jnp.stack([jnp.where(step == 0, cue, 0.0), (step == 5) * 1.0]),
    reward=lambda step, cue, action: jnp.where(step == 5, 1.0 - (action - cue) ** 2, 0.0),
)


def test_a_cue_is_remembered():
    outcome = toy_problems.solve(RECALL, C, iterations=250)
    np.testing.assert_allclose(outcome.mean_action[5], [-1.0, 1.0], atol=0.15)


def test_without_memory_a_cue_is_not_remembered():
    # the control of the test above: the best that is left is 0
    outcome = toy_problems.solve(RECALL, C, iterations=250, memory=False)
    np.testing.assert_allclose(outcome.mean_action[5], 0.0, atol=0.15)
