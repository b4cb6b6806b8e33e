"""Running statistics: counted beyond 32 bits, and by batches what they are of all at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cref_jax import ppo
from cref_jax.ppo.normalization import VARIANCE_FLOOR, Count


def count(number: int) -> Count:
    return Count(jnp.uint32(0), jnp.uint32(0)) + number


@pytest.mark.parametrize(
    ("first", "more"), [(3, 4), (2**32 - 1, 1), (2**32 + 5, 2**31 - 1), (10**10, 0), (7, 3 * 2**33)]
)
def test_a_count_has_64_bits(first, more):
    total = count(first) + more
    assert int(total) == first + more
    assert float(total.as_float()) == pytest.approx(first + more, rel=1e-6)


def test_a_program_counts_across_32_bits():
    add = jax.jit(lambda c, n: c + n)
    assert int(add(count(2**32 - 2), jnp.int32(5))) == 2**32 + 3


def test_batches_give_the_mean_and_deviation_of_all_samples_at_once():
    rng = np.random.default_rng(0)
    x = (rng.normal(size=(6, 5, 4, 2)) * [1.0, 3.0] + [10.0, -2.0]).astype(np.float32)
    valid = rng.random((6, 5, 4)) < 0.7
    statistics = ppo.initial_statistics(2)
    for batch, some in zip(x, valid, strict=True):
        batch = np.where(some[..., None], batch, np.nan)  # what is not valid may be anything
        statistics = ppo.update_statistics(statistics, jnp.asarray(batch), jnp.asarray(some))
    samples = x[valid]
    assert int(statistics.count) == len(samples)
    np.testing.assert_allclose(statistics.mean, samples.mean(axis=0), rtol=1e-5)
    expected = np.sqrt(samples.var(axis=0) + VARIANCE_FLOOR)
    np.testing.assert_allclose(statistics.std, expected, rtol=1e-5)


def test_a_batch_without_a_valid_sample_changes_nothing():
    before = ppo.update_statistics(
        ppo.initial_statistics(1), jnp.ones((2, 2, 1)), jnp.ones((2, 2), bool)
    )
    after = ppo.update_statistics(before, jnp.full((2, 2, 1), jnp.nan), jnp.zeros((2, 2), bool))
    jax.tree.map(np.testing.assert_array_equal, before, after)
