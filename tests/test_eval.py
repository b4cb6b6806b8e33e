"""The command: what it refuses, what it writes, and what it keeps."""

import json
from pathlib import Path

import pytest

from cref_jax import eval
from cref_jax.eval import Options
from cref_jax.evaluation import paper_results, protocol, scene_results, scene_suite
from cref_jax.policy import reader, sources


def said(capsys, *arguments):
    """Return what a refused command says: one line on stderr, and exit code 2."""
    with pytest.raises(SystemExit) as end:
        eval.main(list(arguments))
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--num-envs", "0"], "--num-envs must be 1 to 1000000, not 0"),
        (["--run", "a", "--policy", "b"], "give --run or --policy, not both"),
        (["--suite", "ood", "--policy", "a", "b"], "--suite ood takes one run or policy, not 2"),
        (["--film", "curbs"], "--film takes a scene of --suite ood"),
        (["--policy", "nowhere"], "no run or policy nowhere; bundled are combined, mixed, robust"),
    ],
)
def test_what_cannot_be_judged_is_one_line(capsys, arguments, message):
    assert message in said(capsys, *arguments)


def test_a_scene_that_does_not_exist_is_met_with_the_nearest(capsys):
    bundled = str(sources.bundled_policy())
    error = said(capsys, "--suite", "ood", "--film", "curb", "--policy", bundled)
    assert "unknown scene 'curb'; did you mean 'curbs'?" in error


def test_the_bundled_policy_is_judged_where_there_is_no_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert eval._resolve_sources(Options()) == [sources.bundled_policy()]


def test_a_policy_of_flat_ground_is_judged_on_flat_ground():
    assert eval._suite_for(["flat"]) == "walk"
    assert eval._suite_for(["flat", "flat"]) == "walk"
    assert eval._suite_for(["mixed"]) == eval._suite_for(["flat", "gap"]) == "table"


def test_an_evaluation_of_another_suite_is_kept(tmp_path):
    walk = {"suite": "walk", "episodes": 2, "fell": 1}
    cross = {"suite": "cross", "trials": 4, "successes": 3}
    for record in (walk, cross, cross | {"successes": 2}):
        eval._write(tmp_path, record)
    read = lambda name: json.loads((tmp_path / name).read_text())
    assert read("eval.json")["successes"] == 2  # a newer one of the same suite takes its place
    assert read("eval_walk.json") == walk
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"eval.json", "eval.html", "eval_walk.json", "eval_walk.html"}


def test_the_scenes_are_walked_by_the_runtime(tmp_path, monkeypatch, capsys):
    asked = []

    def judge(path, trials, stress, seed):
        asked.append((Path(path), trials, stress, seed))
        return scene_results.build_verdict({}, {scene_suite.GOOD: {}})

    monkeypatch.setattr(scene_suite, "run_scenes", judge)
    bundled = sources.bundled_policy()
    arguments = ["--suite", "ood", "--policy", str(bundled), "--num-envs", "3", "--seed", "5"]
    eval.main([*arguments, "--out", str(tmp_path)])
    assert asked == [(bundled, 3, 2, 5)]
    record = json.loads((tmp_path / "eval.json").read_text())
    assert record["suite"] == "ood" and record["seed"] == 5
    assert record["policies"][0]["name"] == bundled.name


def test_what_was_learned_in_one_file_is_exported_for_the_runtime(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(eval.writer, "write", lambda policy, world, path: written.append(path))
    policy = reader.read(sources.bundled_policy())
    for source in (Path("learned.npz"), sources.bundled_policy(), Path("policy.zip")):
        with eval._export_subject(eval.Subject(source, policy, None)) as path:
            assert (path == source) == (source.suffix != ".npz")
    assert [path.name for path in written] == ["policy"]


@pytest.mark.slow
def test_the_table_of_the_bundled_policy(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(protocol, "robots_per_block", lambda: 2)
    monkeypatch.setattr(protocol, "TRIAL_SECONDS", 1.0)
    bundled = str(sources.bundled_policy())
    eval.main(["--policy", bundled, bundled, "--num-envs", "2", "--out", str(tmp_path)])
    record = json.loads((tmp_path / "eval.json").read_text())
    cells = {(row["kind"], row["level"]): row for row in record["cells"]}
    assert list(cells) == [
        (kind, level) for kind in paper_results.KINDS for level in paper_results.LEVELS
    ]
    fields = {
        "kind", "level", "size_m", "trials", "successes", "rate", "wilson_low", "wilson_high",
        "up_failures", "down_failures", "failures", "by_speed",
    }  # fmt: skip
    for row in cells.values():
        assert fields <= row.keys()
        assert row["trials"] == 4 and row["successes"] + sum(row["failures"].values()) == 4
        assert row["spread"] == 0.0  # the same policy twice
        assert sum(b["trials"] for b in row["by_speed"]) == 4
    first, second = record["policies"]
    assert first["digest"] == second["digest"] and len(first["digest"]) == 64
    assert record["versions"]["mujoco"] and record["device"] and record["cores"]
    out = capsys.readouterr().out
    assert "network full, trained on mixed for 86.0 M samples" in out
    assert "--suite walk" not in out  # it crosses more than flat ground
    assert "95 % intervals of +-" in out and "stairs 23 cm (OOD)" in out
    assert "eval.html" in out and (tmp_path / "eval.html").stat().st_size > 10_000


def test_a_policy_has_one_digest_as_a_run_and_exported():
    policy = reader.read(sources.bundled_policy())
    digest = reader.policy_digest(policy)
    assert digest == reader.policy_digest(policy._replace(iteration=1, run=Path("elsewhere")))
    seen = policy.train.statistics.obs
    other = policy.train.replace(
        statistics=policy.train.statistics._replace(obs=seen.replace(mean=seen.mean + 1e-3))
    )
    assert digest != reader.policy_digest(policy._replace(train=other))
