"""A robot of one's own, as docs/your_robot.md has it: it loads, stands, and is trained."""

import json
import math
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from biped import BIPED

from cref_jax import config, robot, train
from cref_jax.robot import conventions, registry

PAGE = (Path(__file__).parents[2] / "docs" / "your_robot.md").read_text()


@pytest.fixture
def biped(monkeypatch) -> str:
    monkeypatch.setitem(registry.ROBOTS, "biped", BIPED)
    return "biped"


def test_it_has_its_own_joints_weight_and_height(biped):
    r = robot.load(config.Robot(biped, held="none"))
    assert r.joint_names[:2] == ("left_hip_roll_joint", "left_hip_pitch_joint")
    assert r.num_joints == 10
    # base 4, legs 2 (0.5 + 1 + 0.8 + 0.1 + 0.3), arms 2 x 0.4
    assert r.mass == pytest.approx(10.2)
    assert r.standing_height == pytest.approx(2 * 0.2 * math.cos(0.3) + 0.04, abs=1e-6)
    np.testing.assert_allclose(r.action_scale[:5], 0.25 * 40 / np.array([40, 40, 40, 25, 25]))


def test_it_stands_on_its_own_planes(biped):
    r = robot.load(config.Robot(biped, actuated="all"))
    model = robot.spec("all", config.Physics(), name=biped).compile()
    state = mujoco.MjData(model)
    state.qpos[:7] = [0.0, 0.0, r.standing_height, 1.0, 0.0, 0.0, 0.0]
    state.qpos[7:] = state.ctrl[:] = r.nominal_pose
    mujoco.mj_step(model, state, nstep=80)  # 0.4 s, after which training lets it go
    assert state.xmat[1].reshape(3, 3)[2, 2] > math.cos(0.2)
    assert state.qpos[2] > r.standing_height - 0.03


@pytest.mark.slow
def test_a_training_of_one_iteration_runs_and_names_it(biped, tmp_path):
    tiny = ["--terrain", "flat", "--experiment", "smoke", "--robot", biped, "--num-envs", "2"]
    tiny += ["--iterations", "1", "--ppo.horizon", "8", "--episode.bank-size", "2"]
    tiny += ["--network.variant", "blind", "--device", "cpu", "--no-tensorboard", "--no-evaluate"]
    train.main([*tiny, "--run-dir", str(tmp_path / "run")])
    stored = json.loads((tmp_path / "run" / "config.json").read_text())
    assert stored["robot"]["name"] == biped
    assert stored["reward"]["base_height_target"] == BIPED.base_above_ankles
    (line,) = (tmp_path / "run" / "log.jsonl").read_text().splitlines()
    # of at most its weight, 0.8: exp(-10 |h - h_target|) of a robot that has just been let go
    assert 0.5 < json.loads(line)["reward/base_height"] < 0.8


def test_the_page_has_every_error_that_a_breach_gives():
    """Of a complaint's text, only what stands between the names is fixed."""
    source = Path(conventions.__file__).read_text()
    complaints = [m.group(2) for m in re.finditer(r'yield (f?)"([^"]+)"', source)]
    assert len(complaints) > 10
    said = " ".join(PAGE.split())
    for complaint in complaints:
        for words in re.split(r"\{[^}]*\}", complaint):
            assert words.strip(" ',") in said, complaint
