"""How far robots come off their way, on ways made by hand."""

import numpy as np
import pytest

from cref_jax.evaluation import lateral_drift


def test_drift_is_what_a_robot_is_beside_the_middle_at_the_end():
    # one goes out to 0.4 and comes back, one drifts from 0.1 to -0.2
    y = np.array([[0.1, 0.1], [0.4, 0.0], [0.1, -0.2]])
    drift, largest = lateral_drift.measure(y)
    np.testing.assert_allclose(drift, [0.1, 0.2])
    np.testing.assert_allclose(largest, [0.4, 0.2])
    assert lateral_drift.summarize(drift, largest) == pytest.approx(
        {"drift_m": 0.15, "largest_m": 0.3, "worst_m": 0.4}
    )


def test_what_comes_after_the_end_of_a_trial_is_another_robots():
    y = np.array([[0.1], [0.2], [-0.9]])
    drift, largest = lateral_drift.measure(y, np.array([[True], [True], [False]]))
    np.testing.assert_allclose([drift[0], largest[0]], [0.2, 0.2])
