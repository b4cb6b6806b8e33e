import json
import math

import mujoco
import numpy as np
import pytest

from cref_jax import cli, deploy
from cref_jax.deploy import Status
from cref_jax.errors import ConfigError
from cref_jax.evaluation import scene_results, scene_suite
from cref_jax.evaluation.scene_results import Condition, TrialOutcome
from cref_jax.evaluation.scene_suite import CONDITIONS, GOOD
from cref_jax.policy import sources
from cref_jax.rendering import robot_scene
from cref_jax.system import parallel
from cref_jax.whole_body import scene_files
from cref_jax.whole_body.disturbances import Disturbance

FEW = {name: scene_files.load_named(name) for name in ("flagstones", "steel_grate")}


def outcome(ending, seconds=9.0, status=Status.OK):
    return TrialOutcome(ending, seconds, 5.0, 0.5, status, 0.1, 0.3)


def arguments(seed=0):
    return sources.bundled_policy(), FEW, seed, 0.4


def runner():
    return scene_suite._Runner(*arguments())


def outcomes(jobs, seed=0, workers=1):
    return parallel.run(scene_suite._Runner, arguments(seed), jobs, workers)


def jobs(count, condition=GOOD):
    return [scene_suite._Job(name, n, condition) for name in FEW for n in range(count)]


def test_a_trial_is_the_same_however_many_are_asked_for():
    few, many = (dict(zip(jobs(n), outcomes(jobs(n)), strict=True)) for n in (2, 4))
    assert all(many[job] == found for job, found in few.items())
    assert len({found.progress for found in many.values()}) == len(many)


def test_the_same_seed_gives_the_same_trials_and_another_one_others():
    bad = Condition("bad", Disturbance(dropped=0.3, invalid=0.2))
    first, again, other = (outcomes(jobs(1, bad), seed) for seed in (0, 0, 1))
    assert first == again
    assert all(a != b for a, b in zip(first, other, strict=True))


@pytest.mark.slow
def test_the_trials_do_not_depend_on_the_number_of_processes():
    one, two = (outcomes(jobs(2), workers=workers) for workers in (1, 2))
    assert one == two


def test_a_trial_starts_in_the_same_way_under_every_condition(monkeypatch):
    begun = []

    def note(body, policy, start, seconds, disturbance):
        begun.append((start.base, start.speed, disturbance))
        raise StopIteration

    monkeypatch.setattr(scene_suite, "run_trial", note)
    r = runner()
    for condition in (GOOD, *CONDITIONS):
        with pytest.raises(StopIteration):
            r.trial(scene_suite._Job("flagstones", 3, condition))
    bases, speeds, disturbances = zip(*begun, strict=True)
    assert len({tuple(base) for base in bases}) == len(set(speeds)) == 1
    assert len({d.seed for d in disturbances}) == 1


def test_starts_are_where_they_should_be():
    body = runner()._body("flagstones", 0.9)
    starts = [scene_suite.sample_start(body, "flagstones", 0, n) for n in range(200)]
    bases = np.array([s.base for s in starts])
    yaw = 2.0 * np.arctan2(bases[:, 6], bases[:, 3])
    for values, (low, high) in [
        (bases[:, 0], (0.5, 1.0)),
        (bases[:, 1], (-0.3, 0.3)),
        (yaw, (-0.2, 0.2)),
        (np.array([s.speed for s in starts]), (0.4, 0.8)),
    ]:
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high >= values.max() > high - 0.05 * (high - low)


def test_the_conditions_are_those_that_were_asked_for():
    assert sorted(c.disturbance.dropped for c in CONDITIONS if c.disturbance.dropped) == [
        0.1,
        0.3,
        0.5,
    ]
    late = [c.disturbance.latency for c in CONDITIONS if "late" in c.name]
    assert late == [1, 2, 3, 4, 5]
    assert [c.name for c in CONDITIONS if "late" in c.name][-1] == "frames 100 ms late"
    assert sorted(c.friction for c in CONDITIONS if "friction" in c.name) == [0.4, 0.6, 0.8, 1.0]
    assert len({c.name for c in CONDITIONS}) == len(CONDITIONS) == 20


class Standing(deploy.Policy):
    def __init__(self, joints):
        self.blind, self.status, self.joints = True, Status.OK, joints

    def reset(self):
        pass

    def step(self, angular_velocity, gravity, command, q, qd, now):
        return q


def test_a_policy_that_does_nothing_passes_nothing(monkeypatch, capsys):
    joints = runner().policy().joints
    monkeypatch.setattr(scene_suite._Runner, "policy", lambda self: Standing(joints))
    verdict = scene_suite.run_scenes(
        None, trials=2, stress_trials=1, seconds=2.0, scenes=FEW, workers=1
    )
    assert verdict.passed == 0
    assert [r.trials for r in verdict.scenes] == [2, 2]
    assert [r.trials for r in verdict.conditions] == [4] + [2] * len(CONDITIONS)
    assert all(r.successes == 0 for r in (*verdict.scenes, *verdict.conditions))
    assert all(sum(r.failures.values()) == r.trials for r in verdict.conditions)
    json.dumps(verdict.as_dict(), allow_nan=False)
    monkeypatch.setenv("COLUMNS", "20")  # the tables are whole on a narrow terminal, too
    for table in scene_results.to_tables(verdict):
        cli.print_table(table)
    out = capsys.readouterr().out
    for title in (*(s.title for s in FEW.values()), *(c.name for c in CONDITIONS)):
        assert title in out


def test_half_of_the_trials_pass_a_scene():
    won, lost = outcome("finished"), outcome("low")
    assert scene_results.is_passed([won, lost])
    assert not scene_results.is_passed([won, lost, lost])
    table = {
        GOOD: {"a": [won, lost], "b": [lost, outcome("hit"), won]},
        CONDITIONS[0]: {"a": [lost], "b": [won]},
    }
    verdict = scene_results.build_verdict({"a": "A", "b": "B"}, table)
    assert verdict.passed == 1
    assert [r.passed for r in verdict.conditions] == [1, 1]
    assert [r.successes for r in verdict.scenes] == [1, 1]
    assert verdict.conditions[0].failures == {"low": 2, "hit": 1}
    assert verdict.conditions[1].by_scene == {"a": 0, "b": 1}


def test_a_scenes_result_worked_by_hand():
    found = [outcome("finished", 8.0), outcome("finished", 12.0), outcome("stalled", 20.0)]
    result = scene_results.summarize_scene("a", "A", found)
    assert (result.trials, result.successes, result.failures) == (3, 2, {"stalled": 1})
    assert result.seconds == 10.0
    assert result.wilson_low < result.rate == 2 / 3 < result.wilson_high
    assert scene_results.summarize_scene("a", "A", found[2:]).seconds is None


def test_what_the_policy_said_is_counted_by_trials():
    both = Status.NO_DEPTH | Status.STALE_DEPTH
    found = [outcome("low", status=both), outcome("low", status=Status.NO_DEPTH)]
    result = scene_results.summarize_condition(GOOD, {"a": found})
    assert result.said == {"NO_DEPTH": 2, "STALE_DEPTH": 1}


@pytest.mark.parametrize("bad", [{"trials": 0}, {"stress_trials": -1}, {"seed": -1}])
def test_numbers_that_cannot_be_are_one_line(bad):
    with pytest.raises(ConfigError, match="trials must be at least 1"):
        scene_suite.run_scenes(**bad)


def test_a_folder_that_is_no_policy_is_one_line(tmp_path):
    with pytest.raises(ConfigError, match="not an exported policy"):
        scene_suite.run_scenes(tmp_path)


def test_a_film_is_an_mp4(tmp_path):
    with pytest.raises(ConfigError, match=r"must end in \.mp4"):
        scene_suite.film_trial(None, "curbs", tmp_path / "film.gif")


@pytest.mark.slow
def test_a_trial_can_be_filmed(tmp_path, monkeypatch):
    monkeypatch.setattr(scene_suite, "SIZE", (64, 48))
    monkeypatch.setattr(scene_suite, "TRIAL_SECONDS", 0.2)
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    try:
        robot_scene.Canvas(model, 8, 8).__exit__()
    except ConfigError as error:
        pytest.skip(str(error))
    trial = scene_suite.film_trial(None, "curbs", tmp_path / "film.mp4")
    assert len(trial.qpos) == math.ceil(0.2 / 0.02)
    assert (tmp_path / "film.mp4").stat().st_size > 500
