"""How far robots come off their way, on ways made by hand."""

import numpy as np
import pytest

from cref_jax import sideways


def test_drift_is_from_the_start_to_the_end_and_the_largest_distance_from_the_middle():
    # one goes out to 0.4 and comes back to where it was, one drifts from 0.1 to -0.2
    y = np.array([[0.1, 0.1], [0.4, 0.0], [0.1, -0.2]])
    drift, largest = sideways.spans(y)
    np.testing.assert_allclose(drift, [0.0, 0.3])
    np.testing.assert_allclose(largest, [0.4, 0.2])
    assert sideways.summed(drift, largest) == pytest.approx((0.15, 0.3, 0.4))


def test_what_comes_after_the_end_of_a_trial_is_another_robots():
    y = np.array([[0.1], [0.2], [-0.9]])
    drift, largest = sideways.spans(y, np.array([[True], [True], [False]]))
    np.testing.assert_allclose([drift[0], largest[0]], [0.1, 0.2])
