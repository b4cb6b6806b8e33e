"""The highway gate by terrain, contact phase and posture."""

import numpy as np
import pytest
import small_world
from tiny_policy import policy

from cref_jax.errors import ConfigError
from cref_jax.evaluation import highway_gate
from cref_jax.evaluation.recorder import StepRecords


def test_phases_by_the_feet_in_the_air():
    airborne = np.array([[False, False], [True, False], [False, True], [True, True]])
    expected = ["double support", "single support", "single support", "flight"]
    assert highway_gate.contact_phases(airborne).tolist() == expected


def turned(axis, angle):
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.eye(3)["xyz".index(axis)])])


@pytest.mark.parametrize(
    ("axis", "angle", "posture"),
    [
        ("x", 0.19, "stable"),
        ("x", -0.21, "risky"),
        ("y", 0.19, "stable"),
        ("y", 0.21, "risky"),
        ("y", -0.21, "risky"),
        ("z", 2.0, "stable"),  # the heading is no risk
    ],
)
def test_a_posture_is_risky_beyond_a_fifth_of_a_radian(axis, angle, posture):
    assert highway_gate.postures(turned(axis, angle)[None]).tolist() == [posture]


def test_the_gate_of_a_state_worked_by_hand():
    gate = np.array([[0.1, 0.9], [0.2, 0.9], [0.3, 0.9], [0.4, 0.5]])
    where = np.array([[True, False]] * 3 + [[False, True]])
    row = highway_gate.summarize_state("phase", "flight", gate, where)  # of 0.1, 0.2, 0.3 and 0.5
    assert (row.n, row.robots, row.note) == (4, 2, "n below 100")
    assert row.mean == pytest.approx(0.275)
    assert (row.q25, row.median, row.q75) == pytest.approx((0.175, 0.25, 0.35))


def test_the_first_second_and_what_follows_an_end_do_not_count():
    steps = 60  # of 20 ms; robot 0 walks on flat ground, and its first episode ends after step 56
    gate = np.zeros((steps, 1, 3))
    gate[..., 1:] = 9.0  # the percentiles
    gate[50:55, 0, 0], gate[55:57, 0, 0], gate[57:, 0, 0] = 0.2, 0.9, 7.0
    airborne = np.zeros((steps, 1, 2), bool)
    airborne[55:, 0, 0] = True
    pose = np.tile([0.5, 0.0, 0.6, 1.0, 0.0, 0.0, 0.0], (steps, 1, 1))
    watched = StepRecords(np.arange(steps)[:, None] < 57, highway_gate.Step(gate, airborne, pose))
    rows = {row.state: row for row in highway_gate.make_rows(small_world.world(), watched)}
    assert (rows["flat"].n, rows["flat"].robots) == (7, 1)
    assert rows["flat"].mean == pytest.approx((5 * 0.2 + 2 * 0.9) / 7)
    assert rows["double support"].n == 5 and rows["double support"].mean == pytest.approx(0.2)
    assert rows["single support"].n == 2 and rows["single support"].mean == pytest.approx(0.9)
    assert rows["stable"].n == 7 and rows["risky"].n == rows["gap"].n == 0


@pytest.mark.parametrize("variant", ["no_highway", "hpl"])
def test_a_policy_without_a_gate_is_refused_and_a_blind_one_is_not(variant):
    with pytest.raises(ConfigError, match=f"no gate: its variant is '{variant}'"):
        highway_gate.check_variant(policy(variant).config)
    highway_gate.check_variant(policy("blind").config)
