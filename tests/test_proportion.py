import pytest

from cref_jax.proportion import wilson


def test_wilsons_interval_worked_by_hand():
    # z = 2, n = 16, p = 1/2: z^2/n = 1/4; middle (1/2 + 1/8) / (5/4) = 1/2;
    # half sqrt(1/4 * 1/4 + 1/4 * 1/16) / (5/4) = sqrt(5/64) / (5/4) = 0.2236
    assert wilson(8, 16, z=2.0) == pytest.approx((0.5 - 0.223607, 0.5 + 0.223607), abs=1e-6)


def test_no_success_does_not_mean_never():
    # p = 0, z = 2, n = 4: z^2/n = 1; from 0 to 1 / (1 + 1)
    assert wilson(0, 4, z=2.0) == pytest.approx((0.0, 0.5))
    assert wilson(4, 4, z=2.0) == pytest.approx((0.5, 1.0))


def test_without_trials_nothing_is_known():
    assert wilson(0, 0) == (0.0, 1.0)
