"""How episodes are counted, with outcomes that are known beforehand."""

import json

import numpy as np
import pytest
from tiny_policy import policy

from cref_jax import sim2sim
from cref_jax.config import Config, override
from cref_jax.deploy import Status
from cref_jax.env.state import Ending
from cref_jax.evaluation import crossing, protocol, trials, walking
from cref_jax.evaluation.walking import _EpisodeStep, _summarize
from cref_jax.whole_body.trial import Trial


def trace(alive: np.ndarray, error: float, airborne: np.ndarray) -> _EpisodeStep:
    return _EpisodeStep(
        alive=alive,
        forward_speed=np.full(alive.shape, 0.5, np.float32),
        forward_error=np.full(alive.shape, error, np.float32),
        tracking_error=np.full(alive.shape, abs(error), np.float32),
        airborne=airborne,
        y=np.arange(alive.shape[0])[:, None] * np.full(alive.shape[1], 0.1, np.float32),
    )


def ending(episodes: int, **flags: list[bool]) -> Ending:
    none = np.zeros(episodes, bool)
    return Ending(**{name: np.array(flags.get(name, none)) for name in Ending._fields})


def test_two_of_three_robots_that_fall_are_counted_by_cause():
    alive = np.ones((4, 3), bool)
    end = ending(3, tilted=[True, False, False], low=[False, True, False])
    walk = _summarize(end, trace(alive, 0.1, np.zeros((4, 3, 2), bool)), Config())
    assert (walk.episodes, walk.fell) == (3, 2)
    assert walk.by_cause == {"unstable": 0, "tilted": 1, "low": 1, "hit": 0, "dropped": 0}


def test_a_robot_with_two_causes_counts_once():
    end = ending(
        3, tilted=[True, False, False], low=[True, True, False], finished=[False, False, True]
    )
    causes = walking._count_by_cause(end)
    assert causes == {"unstable": 0, "tilted": 1, "low": 1, "hit": 0, "dropped": 0}


def test_what_comes_after_a_fall_does_not_count():
    # robot 0 lives 2 of 4 steps with an error of 0.2 and would have 9 afterwards; robot 1 has 0.4
    alive = np.array([[1, 1], [1, 1], [0, 1], [0, 1]], bool)
    seen = trace(alive, 0.0, np.zeros((4, 2, 2), bool))
    error = np.array([[0.2, 0.4], [0.2, 0.4], [9.0, 0.4], [9.0, 0.4]], np.float32)
    walk = _summarize(ending(2), seen._replace(forward_error=error), Config())
    assert walk.speed_error == pytest.approx(0.3)  # (0.2 + 0.4) / 2
    assert walk.gait[0]["contacts"] == [[[0.0, 0.04]], [[0.0, 0.04]]]  # both down for two steps
    # 10 cm aside a step: 0.1 and 0.3 m until their ends
    assert walk.sideways == pytest.approx({"drift_m": 0.2, "largest_m": 0.2, "worst_m": 0.3})


def test_feet_after_a_fall_count_neither_as_steps_nor_as_air():
    # one robot falls after 4 of 8 steps: its left foot is up in two of them, and comes down once
    up = np.array([0, 1, 1, 0, 1, 0, 1, 0], bool)
    airborne = np.stack([up, up & (np.arange(8) > 3)], axis=-1)[:, None]
    alive = (np.arange(8) < 4)[:, None]
    walk = _summarize(ending(1, low=[True]), trace(alive, 0.0, airborne), Config())
    assert walk.airborne == (0.5, 0.0)
    assert walk.step_seconds == pytest.approx(2 * 4 * 0.02 / 1)


def test_pooled_episodes_add_up_and_pooled_figures_are_means():
    feet = np.zeros((4, 2, 2), bool)
    feet[:2, :, 0] = True  # the left foot is up half of the time
    alive = np.ones((4, 2), bool)
    one = _summarize(ending(2, low=[True, False]), trace(alive, 0.1, feet), Config())
    two = _summarize(ending(2, low=[True, True]), trace(alive, 0.3, ~feet), Config())
    wide = two._replace(sideways=two.sideways | {"worst_m": 0.9})
    both = walking.pool([one, wide])
    assert (both.episodes, both.fell, both.by_cause["low"]) == (4, 3, 3)
    assert both.speed_error == both.tracking_error == pytest.approx(0.2)
    assert both.airborne == pytest.approx((0.5, 0.5))  # left 0.5, 0.5; right 0, 1
    # one foot comes down once, in 2 robots x 2 feet x 80 ms; in the other walk none does
    assert one.step_seconds == pytest.approx(0.16) and two.step_seconds is None
    assert both.step_seconds == one.step_seconds and "no steps" in two.line()
    assert both.sideways["worst_m"] == 0.9 and both.sideways["drift_m"] == pytest.approx(0.3)
    assert walking.pool([one]) == one


def test_speed_that_errs_both_ways_alike_is_right_on_the_whole():
    alive = np.ones((4, 1), bool)
    seen = trace(alive, 0.0, np.zeros((4, 1, 2), bool))
    error = np.array([[0.2], [-0.2], [0.2], [-0.2]], np.float32)
    walk = _summarize(ending(1), seen._replace(forward_error=error), Config())
    assert walk.speed_error == pytest.approx(0.0, abs=1e-6)


def test_share_in_the_air_and_length_of_a_stride():
    # left foot: 10 steps up, 10 down, over 40 steps of 20 ms: half the time, a stride of 0.4 s
    up = np.tile(np.repeat([True, False], 10), 2)
    airborne = np.stack([up, ~up], axis=-1)[:, None]  # the right foot alternates with it
    walk = _summarize(ending(1), trace(np.ones((40, 1), bool), 0.0, airborne), Config())
    assert walk.airborne == (0.5, 0.5)
    # touchdowns seen: left at 10 and 30, right at 20; 40 steps x 2 feet x 0.02 s / 3 = 0.533 s
    assert walk.step_seconds == pytest.approx(1.6 / 3)


def test_every_trial_begins_at_the_start_of_its_lane_and_goes_along_it():
    trained = override(
        Config(), {"episode": {"start_anywhere": 0.3}, "command": {"lane_free": 0.2}}
    )
    c = protocol.trial_config(trained)
    assert (c.episode.start_anywhere, c.command.lane_free) == (0.0, 0.0)


def test_robots_are_judged_without_noise_or_curriculum_and_told_to_go_forward():
    c = protocol.evaluation_config(Config())
    assert not c.randomisation.enabled and not c.curriculum.enabled
    assert c.command.lane_vx == (0.4, 0.8) and c.command.open_kinds == ()


@pytest.mark.parametrize(
    ("kind", "size", "begin"),
    [("gap", 0.305, "gap 30.5 cm: 9 of"), ("slope", 0.35, "slope 35 %: 9")],
)
def test_a_size_is_said_in_its_unit(kind, size, begin):
    outcome = crossing.LaneResult(kind, size, 10, 9, {"low": 1}, 17.0, 0.6)
    assert outcome.line().startswith(begin)
    assert outcome.line().endswith("failures: 1 low")


def test_the_time_of_a_crossing_is_that_of_those_who_cross(world, monkeypatch):
    ending = np.array([0, 0, trials.ENDINGS.index("low")])
    one, seconds = np.ones(3), np.array([10.0, 14.0, 3.0])
    outcomes = trials.Trials(one, ending, seconds, 0.5 * one, one, one)
    monkeypatch.setattr(crossing.trials, "run", lambda *_: outcomes)
    monkeypatch.setattr(crossing, "crossing_world", lambda *_: world)
    train = policy("blind").train
    found = crossing.cross(world.config, world.physics, train, "gap", 0.3, 3)
    assert (found.successes, found.seconds) == (2, 12.0)


def test_where_nobody_succeeds_there_is_no_time_and_the_record_is_json(world, monkeypatch):
    number = np.full(3, 0.5)
    fell = np.full(3, trials.ENDINGS.index("low"))
    outcomes = trials.Trials(number, fell, number, number, number, number)
    monkeypatch.setattr(crossing.trials, "run", lambda *_: outcomes)
    monkeypatch.setattr(crossing, "crossing_world", lambda *_: world)
    trial = Trial("low", 2.0, 0.3, 0.5, Status.OK, np.zeros((1, 7)))
    options = sim2sim.Options(kind="gap", size=0.3)
    for result in (
        crossing.cross(world.config, world.physics, policy("blind").train, "gap", 0.3, 3),
        sim2sim.summarize([trial] * 3, options),
    ):
        assert json.loads(json.dumps(result._asdict(), allow_nan=False))["seconds"] is None
        assert result.line().startswith("gap 30 cm: 0 of 3 trials crossed, 0.50 m/s; failures: 3")
