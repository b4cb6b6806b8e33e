"""Speeds by logs, and the time that is left."""

import json

import pytest
from fake_commands import FakeRunner

from cref_jax import reproduce
from cref_jax.reproduction import plan as planning
from cref_jax.reproduction import progress
from cref_jax.reproduction.plan import Row


@pytest.fixture
def plan():
    # 8 robots x 24 steps: 192 samples per iteration, 4 iterations
    settings = ("--ppo.minibatches", "2")
    return planning.build(("full", "blind"), (0, 1), "mixed", "cpu", 10, 4 * 192.0, 8, settings)


def write_log(folder, row, rates):
    (folder / row.name).mkdir()
    lines = [{"iteration": k, "samples_per_s": rate} for k, rate in enumerate(rates, 1)]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (folder / row.name / "log.jsonl").write_text(text + '{"iteration": 9, "sam')


def test_without_a_log_the_speed_is_assumed_per_core(tmp_path, plan, monkeypatch):
    monkeypatch.setattr(progress.parallel, "cores", lambda: 2)
    found = progress.forecast(tmp_path, plan)
    # 86.0 M samples in 3:50 h on four cores are 6,232 samples/s, so 3,116 on two
    assert found.rates["full"] == pytest.approx(86.0e6 / 13_800 / 2)
    assert "assumed: 1,558 samples/s per core" in found.source
    # 4 rows x 768 samples
    assert found.left == pytest.approx(3072 / 3115.9, rel=1e-4)
    assert found.evaluation is None


def test_the_speed_of_a_row_is_its_samples_over_their_time(tmp_path, plan):
    # 192 / 100 + 192 / 300 = 2.56 s for 384 samples: 150 per second
    write_log(tmp_path, Row("full", 0), [100, 300])
    found = progress.forecast(tmp_path, plan)
    assert progress.measure_speed(tmp_path, plan, Row("full", 0)) == (384, pytest.approx(2.56))
    assert found.rates == {"full": pytest.approx(150.0), "blind": pytest.approx(150.0)}
    # 768 - 384 samples of that row and three whole ones
    assert found.left == pytest.approx((384 + 3 * 768) / 150.0)
    assert "logs of 1 of 2 variants here; the others have the mean" in found.source
    write_log(tmp_path, Row("blind", 0), [600] * 4)
    # all of blind, seed 0, is done
    left = (384 + 768) / 150.0 + 768 / 600.0
    assert progress.forecast(tmp_path, plan).left == pytest.approx(left)


def test_the_time_of_evaluations_is_their_mean_per_row(tmp_path, plan):
    runner, row = FakeRunner(), Row("full", 0)
    reproduce._complete_row(tmp_path, plan, row, runner, "")
    found = progress.forecast(tmp_path, plan)
    # two suites of 90 s; three rows are left, of 768 samples at 384 per second
    assert found.evaluation == 180.0
    assert found.left == pytest.approx(3 * (180.0 + 2.0))


def test_an_evaluation_of_another_state_does_not_count(tmp_path, plan):
    row = Row("full", 0)
    reproduce._complete_row(tmp_path, plan, row, FakeRunner(), "")
    assert progress.is_finished(tmp_path, plan, row)
    path = progress.evaluation_folder(tmp_path, row, "table") / "eval.json"
    text = path.read_text()
    for wrong in (text.replace('"iteration": 4', '"iteration": 3'), text[:-1], "[]"):
        path.write_text(wrong)
        assert not progress.is_finished(tmp_path, plan, row)
    path.write_text(text)
    assert not progress.is_finished(tmp_path, plan._replace(trials=11), row)
