"""What is on disk of a run is on its page, whatever has become of it."""

import dataclasses
import json
import math
import os

import eval_records
import numpy as np
import pytest
from html_reader import leaves, read
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from cref_jax import config, report
from cref_jax.config import Config
from cref_jax.errors import ConfigError
from cref_jax.pages import learning_charts, run_page, training_log
from cref_jax.policy import sources
from cref_jax.training import run_dir

ORIGIN = {
    "time": "2026-01-02T03:04:05+00:00",
    "command": ["/home/someone/cref_jax/train.py", "--terrain", "gap", "--run-dir", "a b"],
    "python": "3.11.7",
    "device": "1 x cpu",
    "cores": 4,
    "git": "97b27d6a51e99d3005e60651d7d83e8063e490c1+",
    "jax": "0.10.2",
}


def row(iteration, **values):
    line = {
        "iteration": iteration,
        "samples_per_s": 2000,
        "train/samples": 6000.0 * iteration,
        "episode/length_s": 0.0 if iteration % 2 else 10.0,
        "episode/ended": 0.0 if iteration % 2 else 3.0,
        "walk/speed_error": 1.0 / iteration,
        "level/gap": 0.01 * iteration,
        "level/flat": 1.0,
        "fell/gap": 0.5,
        "loss/kl": 0.01,
        "train/learning_rate": 1e-3,
        "reward/orientation": 0.5,
        "reward/stumble": 0.0,
        "loss/value": 0.3,
    }
    return line | values


def write_log(path, rows, end=""):
    path.write_text("".join(json.dumps(line) + "\n" for line in rows) + end)


@pytest.fixture
def run(tmp_path):
    """Return a run of 40 of 100 iterations, without evaluation or film."""
    folder = tmp_path / "run"
    folder.mkdir()
    changes = {"run": {"iterations": 100, "num_envs": 250}, "terrain": {"name": "gap"}}
    run_dir.write_config(folder, config.override(Config(), changes))
    (folder / "origin.jsonl").write_text(json.dumps(ORIGIN) + "\n")
    write_log(folder / "log.jsonl", [row(i) for i in range(1, 41)])
    return folder


def shown(run):
    report.main(["--run", str(run)])
    return read(run / "report.html")


def test_a_page_says_what_a_run_is_how_far_it_is_and_what_made_it(run):
    seen = shown(run)
    assert leaves(seen) == []
    assert "stopped or still training: 40 of 100 iterations" in seen.text
    # 40 x 6000 samples at 2000 a second are 2 minutes
    assert "0.2 Msamples" in seen.text and "2 minof training" in seen.text
    start = next(r for r in seen.rows if r[0] == "2026-01-02 03:04:05 UTC")
    assert start[2] == "python -m cref_jax.train --terrain gap --run-dir 'a b'"
    assert start[3:] == ["1 x cpu", "4", "97b27d6a51e9 with changes"]
    assert "/home/someone" not in seen.text and "jax 0.10.2" in seen.text


def test_settings_that_differ_are_apart_from_all_settings(run):
    rows = [r for r in shown(run).rows if "." in r[0] and " " not in r[0]]
    changed = {r[0]: r[1:] for r in rows if len(r) == 3}
    assert changed == {
        "run.num_envs": ["250", "4096"],
        "run.iterations": ["100", "20000"],
        "terrain.name": ['"gap"', '"flat"'],
    }
    everything = {r[0]: r[1] for r in rows if len(r) == 2}
    assert everything["network.convolutions"] == "[[32, 4, 4], [64, 3, 2]]"
    # each field of each table, and one table more inside of the reward
    tables = [getattr(Config(), f.name) for f in dataclasses.fields(Config)]
    fields = sum(len(dataclasses.fields(t)) for t in [*tables, Config().reward.weights]) - 1
    assert len(everything) == fields


def test_settings_of_another_version_are_shown(run):
    settings = json.loads((run / "config.json").read_text())
    settings["run"]["warp_factor"] = "<9>"
    del settings["ppo"]["gamma"]
    (run / "config.json").write_text(json.dumps(settings))
    rows = shown(run).rows
    assert ["run.warp_factor", '"<9>"', "-"] in rows and ["ppo.gamma", "-", "0.99"] in rows


def test_what_is_missing_is_said_with_the_command_that_makes_it(run):
    (run / "log.jsonl").unlink()
    (run / "origin.jsonl").unlink()
    text = shown(run).text
    assert f'make eval ARGS="--run {run} --suite table"' in text
    assert f'make play ARGS="--run {run}"' in text
    assert f'make train ARGS="--run-dir {run} --resume"' in text
    assert "origin.jsonl is missing or empty" in text


def test_the_newest_evaluation_of_each_suite_is_shown(run):
    (run / "checkpoints" / "40").mkdir(parents=True)
    policies = [{"name": "run", "iteration": 35}, {"name": "run", "iteration": 30}]
    files = {"eval_old.json": eval_records.CROSS | {"successes": 11, "policies": policies}}
    files |= {
        "eval.json": eval_records.CROSS | {"policies": policies},
        "eval_table.json": eval_records.table(3),
    }
    for age, (name, record) in enumerate(files.items()):
        (run / name).write_text(json.dumps(record))
        os.utime(run / name, (1e9 + age, 1e9 + age))
    seen = shown(run)
    assert "95.5 %of 200 trials" in seen.text and "5.5 %of 200 trials" not in seen.words
    assert "Older evaluationseval_old.json" in seen.text
    assert "Measured at iteration 30; the latest checkpoint is 40." in seen.text
    assert next(r for r in seen.rows if r[:2] == ["gap", "hard"])[3] == "124 of 200"
    assert seen.alone == []


@pytest.mark.parametrize("content", ["{", "[]", '{"suite": "table", "cells": [3]}', "null"])
def test_a_damaged_evaluation_does_not_hide_the_rest(run, content):
    (run / "eval.json").write_text(content)
    text = shown(run).text
    assert "eval.json: this evaluation" in text and "Reward terms" in text


def test_pictures_and_films_are_inside_while_there_is_room(run, monkeypatch):
    for k in range(3):
        Image.effect_noise((40, 40), 50.0).save(run / f"{k}.png")
    size = (run / "0.png").stat().st_size
    monkeypatch.setattr(run_page, "MOST_MEDIA", 2 * size + size // 2)
    seen = shown(run)
    assert len([r for r in seen.references if r.startswith("data:image/png")]) == 2
    assert seen.text.count("is left out: it exceeds the limit of") == 1


def test_markup_in_names_and_settings_stays_text(run):
    evil = '<img src="http://x.test/a.png">'
    settings = json.loads((run / "config.json").read_text())
    settings["terrain"]["name"] = evil
    (run / "config.json").write_text(json.dumps(settings))
    start = ORIGIN | {"command": ["train.py", evil], "git": evil, "device": evil}
    (run / "origin.jsonl").write_text(json.dumps(start) + "\n")
    write_log(run / "log.jsonl", [row(i, **{f"fell/{evil}$": 1.0}) for i in range(1, 5)])
    moved = run.rename(run.with_name("<u>run"))
    seen = shown(moved)
    assert leaves(seen) == [] and "u" not in seen.tags
    assert evil in seen.text and "Run <u>run" in seen.text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--run", "{}/nothing"], "nothing is not a run: it has no config.json"),
        (["--run", "{}/file"], "file is not a run: it has no config.json"),
        (["--policy", "{}/nothing"], "nothing"),
        (["--run", "{}/run", "--out", "{}/a.pdf"], "--out must end in .html"),
        (["--run", "{}/run", "--out", "{}/file/a.html"], "cannot make the folder"),
        (["--run", "{}/run", "--policy", "{}/run"], "give --run or --policy, not both"),
    ],
)
def test_a_mistake_is_one_line(run, capsys, options, words):
    (run.parent / "file").write_text("")
    with pytest.raises(SystemExit) as end:
        report.main([option.format(run.parent) for option in options])
    said = capsys.readouterr().err
    assert end.value.code == 2
    assert said.count("\n") == 1 and said.startswith("error: ") and words in said


def test_settings_that_are_no_json_are_one_line(run):
    (run / "config.json").write_text('{"run": ')
    with pytest.raises(ConfigError, match=r"config\.json cannot be read"):
        run_page.read(run)
    (run / "config.json").write_text("[1]")
    with pytest.raises(ConfigError, match=r"config\.json has no settings"):
        run_page.read(run)


def test_without_a_run_the_bundled_policy_is_shown(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    report.main([])
    seen = read(tmp_path / "policy.html")
    manifest = json.loads((sources.bundled_policy() / "manifest.json").read_text())
    assert manifest["digest"] in seen.text and leaves(seen) == []
    for joint in (*manifest["joints"], *manifest["held_joints"]):
        assert next(r for r in seen.rows if r[0] == joint["name"])[4] == f"{joint['kp']:.4g}"


def test_a_start_says_how_many_iterations_are_done(tmp_path):
    run_dir.write_origin(tmp_path, 7)
    assert json.loads((tmp_path / "origin.jsonl").read_text())["iteration"] == 7


# The log


def test_a_line_that_a_power_cut_damaged_is_skipped_and_counted(run):
    write_log(run / "log.jsonl", [row(i) for i in range(1, 21)], '{"iteration": 21, "samp')
    log = training_log.read(run / "log.jsonl")
    assert (log["iteration"][-1], log.damaged) == (20, 1)
    seen = shown(run)
    assert "1 line of the log could not be read" in seen.text


@pytest.mark.parametrize("line", ["", "[]", "3", '"x"', '{"a": 1}', '{"iteration": null}', "\0\0"])
def test_a_line_that_is_no_iteration_is_skipped(tmp_path, line):
    path = tmp_path / "log.jsonl"
    path.write_text(f"{json.dumps(row(1))}\n{line}\n{json.dumps(row(2))}\n")
    log = training_log.read(path)
    assert list(log["iteration"]) == [1, 2] and log.damaged == 1


def test_iterations_that_were_trained_again_count_once(tmp_path):
    # 1 2 3 4, a crash, back to the checkpoint of 2: 3 4 5, another one, back to 3: 4 5 6
    path = tmp_path / "log.jsonl"
    order = [1, 2, 3, 4, 3, 4, 5, 4, 5, 6]
    write_log(path, [row(i, **{"walk/reward": float(k)}) for k, i in enumerate(order)])
    log = training_log.read(path)
    assert list(log["iteration"]) == [1, 2, 3, 4, 5, 6]
    assert list(log["walk/reward"]) == [0, 1, 4, 7, 8, 9]
    assert log.repeated == (3, 4)


def test_columns_that_come_late_or_go_early_and_null_are_not_numbers(tmp_path):
    path = tmp_path / "log.jsonl"
    a, b, c = row(1, early=1.0), row(2, **{"loss/kl": None}), row(3, late=2.0)
    write_log(path, [a, b, c])
    log = training_log.read(path)
    assert np.isnan(log["loss/kl"]).tolist() == [False, True, False]
    assert np.isnan(log["late"]).tolist() == [True, True, False]
    assert np.isnan(log["early"]).tolist() == [False, True, True]


def test_a_log_without_a_line_or_a_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="cannot read"):
        training_log.read(tmp_path / "log.jsonl")
    (tmp_path / "log.jsonl").write_text('{"iter')
    with pytest.raises(ConfigError, match="has no whole line"):
        training_log.read(tmp_path / "log.jsonl")


@given(count=st.integers(1, 5000), most=st.integers(2, 700))
def test_thinning_keeps_the_ends_and_its_limit(count, most):
    at = training_log.even_indices(count, most)
    assert at[0] == 0 and at[-1] == count - 1
    assert len(at) == min(count, most) and (np.diff(at) > 0).all()
    assert len(at) < 2 or np.diff(at).max() - np.diff(at).min() <= 1


@given(
    values=st.lists(st.sampled_from([math.nan, -1.0, 0.5, 2.0]), min_size=1, max_size=30),
    ended=st.lists(st.integers(0, 5), min_size=30, max_size=30),
    window=st.integers(1, 40),
)
def test_smoothing_is_the_mean_of_what_is_known_weighted_by_episodes(values, ended, window):
    count = len(values)
    columns = {"walk/reward": np.array(values), "episode/length_s": np.array(values)}
    columns["episode/ended"] = np.array(ended[:count], float)
    log = training_log.Log(columns, (), 0)
    plain, weighted = (
        training_log.smooth(log, n, window) for n in ("walk/reward", "episode/length_s")
    )
    for k in range(count):
        known = [i for i in range(max(0, k - window + 1), k + 1) if not math.isnan(values[i])]
        mean = np.mean([values[i] for i in known]) if known else math.nan
        np.testing.assert_allclose(plain[k], mean, atol=1e-9)
        episodes = sum(ended[i] for i in known)
        total = sum(ended[i] * values[i] for i in known)
        np.testing.assert_allclose(
            weighted[k], total / episodes if episodes else math.nan, atol=1e-9
        )


def test_a_very_large_value_is_in_its_own_windows_alone():
    values = np.full(30, 0.5)
    values[10] = 1e17
    mean = training_log.smooth(training_log.Log({"loss/kl": values}, (), 0), "loss/kl", 5)
    assert list(mean) == [*[0.5] * 10, *[2e16] * 5, *[0.5] * 15]


def test_iterations_in_which_no_episode_ended_do_not_shorten_the_episodes(run):
    # every other iteration says 0 s of 0 episodes; the others 10 s of 3
    assert "10.0 sepisode length, last 10 iterations" in shown(run).text


def test_a_restart_is_marked_where_it_was(run):
    starts = [ORIGIN | {"iteration": 0}, ORIGIN | {"iteration": 20}, ORIGIN]
    (run / "origin.jsonl").write_text("".join(json.dumps(s) + "\n" for s in starts))
    text = shown(run).text
    assert "Dotted lines mark restarts of the run (iteration 21)" in text
    assert "The run was started 3 times" in text


def test_a_long_log_does_not_make_a_large_page(tmp_path):
    def size(count):
        path = tmp_path / "log.jsonl"
        rng = np.random.default_rng(0)
        values = {"loss/kl": rng.random(count), "loss/value": rng.random(count)}
        rows = ({k: float(v[i]) for k, v in values.items()} for i in range(count))
        write_log(path, (row(i + 1, **new) for i, new in enumerate(rows)))
        sections = learning_charts.sections(training_log.read(path), (), None, 1)
        return sum(len(section.body) for section in sections)

    assert size(20_000) < 1.1 * size(2_000)


def test_terms_without_weight_are_named_and_not_drawn(run):
    text = shown(run).text
    assert "Zero throughout: stumble." in text
