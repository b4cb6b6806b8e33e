import math
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
from tiny_policy import policy

from cref_jax import config
from cref_jax.config import folders
from cref_jax.errors import ConfigError
from cref_jax.evaluation import crossing, protocol, scene_suite, whole_robot
from cref_jax.evaluation.scene_results import Condition
from cref_jax.live import film, policies
from cref_jax.live.clock import Clock
from cref_jax.live.session import OVER, Session, Wish
from cref_jax.live.stage import Place, StageBuilder
from cref_jax.physics.simulation import Physics
from cref_jax.whole_body.trial import run_trial

ROBUST = policies.load(Path("robust"))
CURBS = StageBuilder(seed=0).build(ROBUST, Place(scene="curbs"))
DOWN = np.array([0.0, 0.0, -1.0])
SECONDS = 1.0  # 50 control steps


def session(stage=CURBS):
    return Session(stage)


def steps(s, count):
    for _ in range(count):
        s.step()
    return s.view()


def falling(start=0):
    """Return a session whose robot lies on its back soon."""
    leaning = CURBS.starts[start]
    base = leaning.base.copy()
    base[2] += 0.2
    base[3:7] = [math.cos(0.25), 0.0, -math.sin(0.25), 0.0]  # 29 deg backwards
    return session(CURBS._replace(starts=[leaning._replace(base=base), *CURBS.starts[1:]]))


def test_a_session_walks_as_the_trial_of_the_same_seed_bit_for_bit():
    s, qpos = session(), []
    trial = run_trial(CURBS.body, ROBUST.runtime(), CURBS.starts[0], SECONDS)
    for _ in range(len(trial.qpos)):
        qpos.append(s.view().qpos)
        s.step()
    assert len(qpos) == 50
    np.testing.assert_array_equal(np.stack(qpos), trial.qpos)


def test_a_scene_begins_as_the_scene_suite_does():
    runner = scene_suite._Runner(policies.sources.bundled_policy("robust"),
                                 {"curbs": CURBS.ground}, 0, SECONDS)  # fmt: skip
    for number in range(2):
        theirs = runner.trial(scene_suite._Job("curbs", number, Condition("good")))
        np.testing.assert_array_equal(theirs.qpos[0, :7], CURBS.starts[number].base)


def test_a_lane_has_the_shape_of_its_terrain(tmp_path):
    file = tmp_path / "shallow.toml"
    gap = (folders.data_folder("terrains") / "gap.toml").read_text()
    file.write_text(gap.replace("depth = 1.0", "depth = 0.25"))
    depth = lambda place: StageBuilder(seed=0).build(ROBUST, place).ground.heights.min()
    assert depth(Place("gap", 0.3, str(file))) == pytest.approx(-0.25)
    assert depth(Place("gap", 0.3)) == pytest.approx(-1.0)


@pytest.mark.slow
def test_a_lane_is_that_of_sim2sim_and_so_are_its_starts():
    stage = StageBuilder(seed=3).build(ROBUST, Place("gap", 0.3))
    physics = Physics(ROBUST.config.robot, ROBUST.config.physics, "mujoco")
    world = crossing.crossing_world(ROBUST.config, physics, "gap", 0.3)
    np.testing.assert_array_equal(stage.ground.heights, whole_robot.to_lane(world).heights)
    assert stage.ground.end == whole_robot.to_lane(world).end
    theirs = whole_robot.initial_states(world, 3, 6)
    for ours, number in ((0, 0), (1, len(protocol.LANE_SEEDS))):
        assert stage.starts[ours].speed == theirs[number].speed
        np.testing.assert_array_equal(stage.starts[ours].base, theirs[number].base)
        np.testing.assert_array_equal(stage.starts[ours].q, theirs[number].q)


def test_the_robot_is_asked_for_what_people_want():
    s = session()
    s.drive(Wish(0.3, 0.1, -0.5, keep_lane=False))
    np.testing.assert_array_equal(steps(s, 1).command, [0.3, 0.1, -0.5])


def test_until_people_ask_the_speed_is_that_of_the_start():
    s = session()
    assert s.wish.vx == CURBS.starts[0].speed
    s.drive(s.wish._replace(vx=0.25))
    s.reset()
    assert steps(s, 1).command[0] == 0.25


def test_a_push_changes_the_velocity_of_the_base_at_once(monkeypatch):
    """The robot looks along +y: from behind is +y, from its right is -x."""
    s, turned = session(), np.sqrt(0.5)
    state = s._episode.state
    state.qpos[3:7] = [turned, 0.0, 0.0, turned]
    monkeypatch.setattr(s._episode, "step", lambda command: None)
    s.push(0.0, 0.5)
    s.push(0.5 * math.pi, 0.25)
    s.step()
    np.testing.assert_allclose(state.qvel[:3], [-0.25, 0.5, 0.0], atol=1e-12)
    s.step()
    np.testing.assert_allclose(state.qvel[:3], [-0.25, 0.5, 0.0], atol=1e-12)


def test_a_fall_is_named_and_the_next_start_comes_two_seconds_later():
    s = falling()
    while not (view := steps(s, 1)).is_over:
        assert view.seconds < 5.0
    assert view.note == OVER[s.ending] and view.note.startswith("Fell")
    assert steps(s, 100).episode == 1
    after = steps(s, 1)
    assert (after.episode, after.seconds, after.note) == (2, 0.0, "")
    np.testing.assert_array_equal(after.qpos[:7], CURBS.starts[1].base)


def test_a_fall_can_wait_for_people():
    s = falling()
    s.restarts = False
    assert steps(s, 400).is_over
    s.reset()
    assert not s.view().is_over


def test_a_simulation_that_blew_up_is_not_stepped_on():
    s = session()
    s.restarts = False
    s._episode.state.qpos[2] = np.nan
    steps(s, 3)
    assert s.ending == "unstable"
    assert s.view().seconds == pytest.approx(0.02)


def test_told_to_stop_it_stands_until_told_to_walk():
    s = session()
    s.stop()
    view = steps(s, 20)
    assert view.is_stopped and "the robot stands" in view.why
    np.testing.assert_array_equal(view.command, np.zeros(3))
    s.walk()
    view = steps(s, 20)
    assert not view.is_stopped and "the robot stands" not in view.why


def test_the_touchdowns_are_on_the_ground_left_and_right_in_turn():
    """As a ray from above finds it, which hits nothing but the ground."""
    s = session()
    view = steps(s, 150)
    feet = [foot for foot, _ in view.touchdowns]
    assert feet == [feet[0], 1 - feet[0]] * (len(feet) // 2) + feet[:1] * (len(feet) % 2)
    assert len(feet) >= 3
    only_ground, geom = np.array([1, 0, 0, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
    for _, at in view.touchdowns:
        fall = mujoco.mj_ray(
            CURBS.body.model, s._episode.state, at - DOWN, DOWN, only_ground, 1, -1, geom
        )
        assert fall == pytest.approx(1.0, abs=0.03)


def test_another_ground_and_policy_take_the_place_of_the_first():
    s = session()
    steps(s, 10)
    mixed = policies.load(Path("mixed"))
    s.begin(StageBuilder(seed=0).build(mixed, Place(scene="planks")))
    view = steps(s, 1)
    assert (view.stage.policy.name, view.stage.place.scene) == ("mixed", "planks")
    assert view.seconds == pytest.approx(0.02)


def test_a_paused_clock_makes_single_steps():
    s = session()
    clock = Clock(s)
    clock.paused = True
    clock.start()
    for count in (1, 2, 3):
        clock.step_once()
        assert s.view().seconds == pytest.approx(0.02 * count)
    clock.stop()
    assert s.view().seconds == pytest.approx(0.06)


def test_a_failure_is_over_when_a_step_succeeds(monkeypatch):
    s, fails = session(), [True, True]
    whole = s.step
    monkeypatch.setattr(s, "step", lambda: 1 / 0 if fails else whole())
    clock = Clock(s)

    def wait(until):
        for _ in range(500):
            if until():
                return True
            time.sleep(0.01)

    clock.start()
    assert wait(lambda: clock.failure) and clock.paused
    fails.clear()
    clock.paused = False
    assert wait(lambda: clock.failure is None)
    clock.stop()
    clock.failure = ZeroDivisionError()
    clock.step_once()
    assert clock.failure is None


def test_the_clock_says_how_fast_time_passed(monkeypatch):
    """Steps of 20 ms, one every 40 ms: half of real time."""
    clock = Clock(session())
    clock._done.extend(0.04 * k for k in range(26))
    monkeypatch.setattr(time, "perf_counter", lambda: 1.0)
    assert clock.share == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("place", "message"),
    [
        (Place(scene="curb"), "curbs"),
        (Place("stairs"), "there is no kind of lane 'stairs'"),
        (Place(map=Path("nowhere.npy")), "no file nowhere.npy"),
    ],
)
def test_a_ground_that_there_is_not_is_one_line(place, message):
    with pytest.raises(ConfigError, match=message):
        StageBuilder(seed=0).build(ROBUST, place)


def test_a_newer_state_of_the_policy_walks_from_the_next_start_on():
    s, newer = session(), ROBUST._replace(detail="iteration 7")
    s.take_policy(newer)
    s.take_policy(policies.load(Path("mixed")))  # another policy: not a state of this one
    assert steps(s, 5).stage.policy.detail == ""
    s.reset()
    view = steps(s, 5)
    assert (view.stage.policy.name, view.stage.policy.detail) == ("robust", "iteration 7")


def test_another_ground_is_walked_on_with_the_newest_state_of_the_policy():
    def state(iteration):
        origin = ROBUST.manifest["provenance"] | {"iteration": iteration}
        manifest = ROBUST.manifest | {"provenance": origin}
        return ROBUST._replace(detail=f"iteration {iteration}", manifest=manifest)

    s = session(CURBS._replace(policy=state(1)))
    walks = lambda: steps(s, 1).stage.policy.detail
    assert s.take_policy(state(2))
    s.begin(CURBS._replace(policy=state(1)))  # built while the newer one came
    assert walks() == "iteration 2"
    assert s.take_policy(state(3))
    s.begin(CURBS._replace(policy=state(4)))  # read again from its folder
    assert walks() == "iteration 4"
    s.reset()
    assert walks() == "iteration 4"
    assert not s.take_policy(policies.load(Path("mixed")))


@pytest.mark.parametrize(
    ("wish", "note"), [(0.0, ""), (0.05, ""), (-0.05, ""), (0.5, "Hardly moves")]
)
def test_only_who_is_to_walk_hardly_moves(monkeypatch, wish, note):
    s = session()
    monkeypatch.setattr(s._episode, "step", lambda command: "stalled")
    s.drive(Wish(wish))
    assert steps(s, 1).note == note
    s.stop()
    assert steps(s, 1).note == ""


def test_a_run_that_the_runtime_has_no_network_for_is_one_line(world, tmp_path, monkeypatch):
    full = policy("full")
    c = config.override(full.config, {"network": {"variant": "hpl_teacher"}})
    teacher = full._replace(config=c)
    monkeypatch.setattr(policies.sources, "load", lambda *_: teacher)
    with pytest.raises(ConfigError, match=r"network\.variant must be .*, not 'hpl_teacher'"):
        policies.load(tmp_path, world)


def test_a_film_holds_every_second_step_until_it_ends():
    s = session()
    s.start_film()
    steps(s, 10)
    taken = s.end_film()
    steps(s, 10)
    assert len(taken.moments) == 5  # 25 of 50 per second
    assert s.end_film() is None


def test_another_ground_ends_a_film():
    s = session()
    s.start_film()
    steps(s, 4)
    s.begin(CURBS._replace(starts=CURBS.starts[1:]))
    steps(s, 4)
    assert len(s.end_film().moments) == 2


@pytest.mark.slow
def test_a_film_can_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(film, "SIZE", (64, 540))
    s = session()
    s.start_film()
    steps(s, 4)
    try:
        film.write_film(tmp_path / "live.mp4", s.end_film())
    except ConfigError as error:
        pytest.skip(str(error))
    assert (tmp_path / "live.mp4").stat().st_size > 500
