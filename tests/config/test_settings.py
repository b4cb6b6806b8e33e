"""Settings are found by name, of the right type, and refused in words that help."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from cref_jax import config
from cref_jax.config import Config, limits
from cref_jax.errors import ConfigError


def test_changes_reach_nested_settings_and_leave_the_rest():
    c = config.override(Config(), {"ppo": {"epochs": 2}, "reward": {"weights": {"stumble": -1.0}}})
    assert (c.ppo.epochs, c.reward.weights.stumble) == (2, -1.0)
    assert dataclasses.replace(c, ppo=config.PPO(), reward=config.Reward()) == Config()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"pqo": {}}, "unknown setting 'pqo'; did you mean 'ppo'?"),
        ({"ppo": {"epoch": 1}}, "unknown setting 'ppo.epoch'; did you mean 'epochs'?"),
        ({"ppo": 3}, "'ppo' is a table of settings, not 3"),
        ({"ppo": {"epochs": "3"}}, "'ppo.epochs' must be int, not '3'"),
        ({"ppo": {"epochs": True}}, "'ppo.epochs' must be int, not True"),
        ({"command": {"vx": [0.1]}}, "'command.vx' takes 2 values, not 1"),
        ({"command": {"vx": 0.1}}, "'command.vx' must be a list, not 0.1"),
        ({"robot": {"actuated": "arms"}}, "'robot.actuated' must be one of 'legs'"),
    ],
)
def test_what_cannot_be_used_is_refused_by_name(changes: dict, says: str):
    with pytest.raises(ConfigError, match=re.escape(says)):
        config.override(Config(), changes)


def test_a_whole_number_may_stand_for_a_real_one():
    assert config.override(Config(), {"ppo": {"clip": 1}}).ppo.clip == 1.0


def test_settings_survive_json():
    stored = json.loads(json.dumps(dataclasses.asdict(Config())))
    assert config.override(Config(), stored) == Config()


def test_a_file_that_is_missing_or_broken_is_named(tmp_path: Path):
    with pytest.raises(ConfigError, match="no file"):
        config.load_toml(tmp_path / "none.toml")
    (tmp_path / "broken.toml").write_text("a = ")
    with pytest.raises(ConfigError, match=r"broken\.toml"):
        config.load_toml(tmp_path / "broken.toml")


def test_robots_that_do_not_split_get_the_nearest_numbers_that_do():
    few = config.override(Config(), {"run": {"num_envs": 3}, "ppo": {"minibatches": 4}})
    with pytest.raises(ConfigError, match="take 4"):
        limits.check(few)
    limits.check(Config())


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"camera": {"shape": [58, 88]}}, "--camera.shape: 58 rows do not split .* take 56"),
        ({"camera": {"shape": [48, 87]}}, "87 columns do not split .* take 88"),
        ({"network": {"heads": 3}}, "--network.token, 128, does not split into 3 heads"),
        ({"network": {"initial_std": -1.0}}, "--network.initial-std must be 0.001 to 10, not -1"),
        ({"ppo": {"gamma": 1.5}}, "--ppo.gamma must be 0 to 1, not 1.5"),
        ({"ppo": {"learning_rate": float("nan")}}, "--ppo.learning-rate must be .*, not nan"),
        ({"foothold": {"stride": 0}}, "--foothold.stride must be 1 to 1000, not 0"),
        ({"scan": {"x": [0.0, 1.0, 0]}}, "--scan.x must be from, to, samples"),
        (
            {"network": {"variant": "hpl_teacher"}, "ppo": {"mirror_weight": 1.0}},
            "--ppo.mirror-weight must be 0 with --network.variant hpl_teacher",
        ),
        (
            {"network": {"variant": "hpl"}, "distillation": {"teacher_iterations": 20_000}},
            "--distillation.teacher-iterations must be below --run.iterations, 20000, not 20000",
        ),
        ({"network": {"variant": "hpl", "convolutions": [[4, 48, 2]]}}, "leave no pixel"),
        ({"run": {"seed": 2**32}}, "--run.seed must be 0 to 4294967295"),
    ],
)
def test_what_cannot_run_is_refused_before_anything_is_compiled(changes, says):
    with pytest.raises(ConfigError, match=says):
        limits.check(config.override(Config(), changes))


def test_a_blind_policy_takes_any_image():
    blind = {"network": {"variant": "blind"}, "camera": {"shape": [58, 87]}}
    limits.check(config.override(Config(), blind))


def test_the_horizon_is_half_a_second_and_a_control_step_20_ms():
    assert Config().physics.control_period == pytest.approx(0.020)  # Sec. II-D: 50 Hz
    assert Config().run.num_envs == 4096 and Config().run.iterations == 20_000  # Sec. II-D
