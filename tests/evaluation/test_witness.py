"""What is kept of trials whose walks are made by hand, and films of them."""

import numpy as np
import pytest

from cref_jax import config
from cref_jax.config import Config
from cref_jax.errors import ConfigError
from cref_jax.evaluation import failure_films, tables, trials, witness
from cref_jax.evaluation.trials import Walk
from cref_jax.evaluation.witness import Witness
from cref_jax.physics.simulation import Physics
from cref_jax.rendering import robot_scene
from cref_jax.terrain import cross_section

C = config.override(
    Config(),
    {
        "terrain": {"lane_length": 5.0, "lane_width": 1.0},
        "episode": {"bank_size": 4},
        "network": {"variant": "blind"},
    },
)
RISE = 0.2  # m
CELLS = [{"kind": "stairs", "level": "hard", "size_m": RISE}, {"kind": "gap", "size_m": 0.3}]


@pytest.fixture(scope="module")
def world():
    physics = Physics(C.robot, C.physics, "mujoco")
    sized = {"ascent": [RISE], "descent": [RISE], "gap": [0.3]}
    return tables.make_lane_world(C, physics, sized)


def specs():
    """Return two trials on stairs, one up and one down, and two over a gap."""
    return trials.TrialSpecs(np.array([0, 1, 0, 1]), np.array([0, 1, 2, 2]), np.zeros(4, int))


def standing(world, steps, x=0.5, z=0.0, ending="finished"):
    """Return a walk that stands nominally with its base at x on ground of height z."""
    robot = world.physics.robot
    base = [x, 0.0, z + robot.standing_height, 1.0, 0.0, 0.0, 0.0]
    qpos = np.tile(np.concatenate([base, robot.rest_pose]).astype(np.float32), (steps, 1))
    return Walk(qpos, np.zeros((steps, 2), bool), ending)


def landing(world, kind, places):
    """Return a walk whose left foot comes down on the third tread at each of these x, m."""
    stairs = cross_section.from_lane(world.lanes.tile(0, kind))
    tread = np.flatnonzero(stairs.flight)[2]
    parts = []
    for x in places:
        walk = standing(world, 6, stairs.left[tread] + x, float(stairs.height[tread]))
        walk.airborne[:4, 0] = True  # 0.08 s, then down
        parts.append(walk)
    qpos, airborne = (np.concatenate([getattr(w, k) for w in parts]) for k in ("qpos", "airborne"))
    return Walk(qpos, airborne, "finished")


def test_touchdowns_are_measured_from_the_nosing_up_and_down(world):
    saw = Witness()
    look = saw.watch(world, CELLS, specs())
    look(0, landing(world, 0, [0.10, 0.14, 0.20]))
    look(1, landing(world, 1, [0.10, 0.14, 0.20]))
    look(2, standing(world, 20))
    groups = saw.record()["touchdowns"]["groups"]
    rows = {(group["way"], group["foot"]): group for group in groups}
    up, down = rows["up", "left"], rows["down", "left"]
    assert up["touchdowns"] == down["touchdowns"] == 3
    assert rows["up", "right"]["touchdowns"] == 0
    assert up["mad_m"] == down["mad_m"] == pytest.approx(0.04, abs=1e-3)
    # the nosing is at the near end on the way up and at the far end, 30 cm on, on the way down
    assert up["median_m"] + down["median_m"] == pytest.approx(0.30, abs=1e-3)
    assert up["median_m"] == pytest.approx(0.14, abs=0.06)  # soles stand about below the base


def test_the_gait_is_that_of_the_first_trial_of_each_lane(world):
    saw = Witness()
    look = saw.watch(world, CELLS, specs())
    late, early = standing(world, 50), standing(world, 50)
    late.airborne[:, 0] = True
    early.airborne[:10, 1] = True
    look(3, late)
    look(2, early)
    (gait,) = saw.record()["gait"]
    assert (gait["lane"], gait["size_m"], gait["airborne"]) == ("gap", 0.3, [0.0, 0.2])


def test_cells_with_the_most_failures_come_first_each_with_its_first_trial(world):
    saw = Witness()
    look = saw.watch(world, CELLS, specs())
    look(3, standing(world, 400, ending="stalled"))
    look(1, standing(world, 100, ending="tilted"))
    look(2, standing(world, 200, ending="hit"))
    first, second = saw.worst(5)
    assert (first.cell, first.failures, first.number, first.ending) == (CELLS[1], 2, 0, "hit")
    assert first.seconds == pytest.approx(4.0)
    assert (second.cell, second.failures, second.lane) == (CELLS[0], 1, (1, 0))
    assert [failure.cell for failure in saw.worst(1)] == [CELLS[1]]
    saw._keep_failure(1, CELLS[1], 5, (2, 0), standing(world, 9))
    assert saw.worst(1)[0].number == 0 and saw.worst(1)[0].failures == 3


def test_of_a_failure_the_last_seconds_are_kept(world):
    saw = Witness()
    walk = standing(world, 500, ending="low")
    walk.qpos[:, 0] = np.arange(500)
    saw.watch(world, CELLS, specs())(0, walk)
    kept = saw.worst(1)[0].qpos[:, 0]
    assert len(kept) == witness.TAIL / C.physics.control_period and kept[-1] == 499


def test_where_nothing_is_seen_nothing_is_shown(world):
    saw = Witness()
    saw.watch(world, [None, None], specs())(0, standing(world, 5, ending="low"))
    assert saw.record() == {"gait": []} and saw.worst(3) == []


def test_without_opengl_a_film_says_why(world, tmp_path, monkeypatch):
    def refuse(*_):
        raise ConfigError("rendering needs OpenGL")

    monkeypatch.setattr(robot_scene, "Canvas", refuse)
    (row,) = failure_films.write(world, [failed(world)], tmp_path / "films")
    assert row["why"] == "rendering needs OpenGL" and "file" not in row
    assert failure_films.describe(row, tmp_path) == "no film of failures: rendering needs OpenGL"


def test_a_failure_is_filmed_from_the_recorded_poses(world, tmp_path):
    (row,) = failure_films.write(world, [failed(world)], tmp_path / "films")
    if "why" in row:
        pytest.skip(row["why"])
    assert row["file"] == "films/stairs-hard.mp4"
    assert (tmp_path / row["file"]).read_bytes()[4:8] == b"ftyp"
    seen = {"lane": "ascent", "failures": 1, "trial": 0, "ending": "low", "seconds": 0.4}
    assert row == CELLS[0] | seen | {"file": row["file"]}


def failed(world):
    saw = Witness()
    saw.watch(world, CELLS, specs())(0, standing(world, 20, ending="low"))
    return saw.worst(1)[0]
