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
    assert robot.fill_in(full) == full
