"""What a robot knows of itself: targets of Table I, and settings left to it."""

import mujoco
import pytest

from cref_jax import config, robot
from cref_jax.config import Config, override
from cref_jax.robot.registry import ROBOTS, describe


@pytest.mark.parametrize("name", ROBOTS)
def test_the_heights_of_a_robot_are_those_of_its_model_in_the_nominal_pose(name):
    data, whole = describe(name), robot.load(config.Robot(name, actuated="all"))
    model = robot.spec("all", config.Physics(), 0, visual=True, name=name).compile()
    state = mujoco.MjData(model)
    state.qpos[2], state.qpos[7:] = whole.standing_height, whole.nominal_pose
    mujoco.mj_kinematics(model, state)
    left, right = state.xpos[list(whole.ankles)]
    assert data.base_height == pytest.approx(whole.standing_height, abs=0.01)
    assert data.base_above_ankles == pytest.approx(whole.standing_height - left[2], abs=0.01)
    assert data.feet_apart == pytest.approx(left[1] - right[1], abs=0.02)
    assert 0.0 < data.fallen_below < 0.5 * data.base_above_ankles


def test_a_setting_that_is_given_stays_and_the_rest_is_the_robots():
    given = override(Config(), {"reward": {"base_height_target": 0.5}})
    full = robot.fill_in(given)
    assert (full.reward.base_height_target, full.reward.feet_y_target) == (0.5, 0.27)
    assert (full.scan.base_height, full.episode.min_height) == (0.62, 0.15)
    assert (full.robot.name, full.camera.pitch) == ("x2_ultra", 50.0)
    assert robot.fill_in(full) == full


def test_the_robot_that_is_asked_for_comes_before_that_of_the_settings():
    asked = robot.fill_in(override(Config(), {"robot": {"name": "x2_ultra"}}), "g1")
    assert (asked.robot.name, asked.camera.pitch) == ("g1", 47.6)
    # the sole from 5.5 cm behind the ankle to 13 cm ahead of it, 6 cm wide
    assert (asked.foothold.quality_x, asked.foothold.quality_y) == (
        (-0.055, 0.13, 5),
        (-0.03, 0.03, 3),
    )
