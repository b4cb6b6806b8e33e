"""A run remembers the map that it began on, and the command."""

import json
import subprocess

import numpy as np
import pytest

from cref_jax.config import Config
from cref_jax.errors import ConfigError
from cref_jax.training import run_dir

C = Config()  # 4096 robots, a horizon of 24 steps


@pytest.fixture
def hill(tmp_path):
    np.save(tmp_path / "hill.npy", np.zeros((20, 20)))
    (tmp_path / "hill.toml").write_text("cell = 0.1\nstart = [0.5, 1.0]\n")
    return tmp_path / "hill.npy"


@pytest.mark.parametrize("changed", ["hill.npy", "hill.toml"])
def test_a_map_that_has_changed_is_not_gone_on_with(tmp_path, hill, changed):
    run_dir.write_origin(tmp_path, 0, str(hill))
    run_dir.check_map(tmp_path, str(hill))
    (tmp_path / changed).write_bytes((tmp_path / changed).read_bytes() + b"\n")
    with pytest.raises(ConfigError, match=f"has changed since {tmp_path} began; .* --init"):
        run_dir.check_map(tmp_path, str(hill))


def test_a_terrain_that_is_no_map_leaves_no_digest(tmp_path):
    run_dir.write_origin(tmp_path, 0, "flat")
    assert "map" not in json.loads((tmp_path / "origin.jsonl").read_text())
    run_dir.check_map(tmp_path, "flat")
    run_dir.check_map(tmp_path / "nothing", "flat")


@pytest.mark.parametrize(
    ("command", "value"),
    [
        ([], None),
        (["train", "--seed", "3"], None),
        (["train", "--experiment", "robust", "--seed", "3"], "robust"),
        (["train", "--experiment=robust"], "robust"),
    ],
)
def test_an_option_is_read_from_the_command_that_began_a_run(tmp_path, command, value):
    (tmp_path / "origin.jsonl").write_text(json.dumps({"command": command}) + "\n{}\n")
    assert run_dir.first_option(tmp_path, "experiment") == value


def test_runs_of_one_second_have_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runs = [run_dir.reserve("flat-20261127-101500") for _ in range(3)]
    assert [run.name[-6:] for run in runs] == ["101500", "1500-2", "1500-3"]
    assert all(run.is_dir() for run in runs)


def test_a_folder_that_cannot_be_written_is_named_and_nothing_is_made(tmp_path, monkeypatch):
    run_dir.check_writable(tmp_path / "new" / "run")
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(ConfigError, match=f"cannot write in {folder}: .*file is a file"):
            run_dir.check_writable(folder)
    monkeypatch.setattr(run_dir.os, "access", lambda *_: False)
    with pytest.raises(ConfigError, match=f"no permission for {tmp_path}$"):
        run_dir.check_writable(tmp_path / "new" / "run")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_engine_of_the_last_start_is_remembered(tmp_path):
    assert run_dir.last_engine(tmp_path) is None
    for iteration, engine in enumerate(("mujoco", "warp")):
        run_dir.write_origin(tmp_path, iteration, engine=engine)
    assert run_dir.last_engine(tmp_path) == "warp"


def test_samples_are_counted_by_the_robots_of_each_start(tmp_path):
    count = lambda iteration: run_dir.count_samples(tmp_path, C, iteration)
    assert count(10) == 10 * 4096 * 24  # no start is known: the settings' robots
    run_dir.write_origin(tmp_path, 0, num_envs=100)
    run_dir.write_origin(tmp_path, 30, num_envs=10)
    run_dir.write_origin(tmp_path, 20, num_envs=1)  # from an older checkpoint: 20 to 30 anew
    assert count(20) == 20 * 100 * 24
    assert count(50) == (20 * 100 + 30 * 1) * 24


def test_a_cut_last_line_loses_that_start_alone(tmp_path):
    run_dir.write_origin(tmp_path, 0, num_envs=100)
    with (tmp_path / "origin.jsonl").open("a") as file:
        file.write('{"iteration": 10, "num_')
    run_dir.write_origin(tmp_path, 30, num_envs=10)
    assert run_dir.count_samples(tmp_path, C, 50) == (30 * 100 + 20 * 10) * 24


@pytest.mark.parametrize(
    "line", ["5", '{"command": 5}', '{"command": [5]}', '{"num_envs": "a"}', '{"iteration": null}']
)
def test_a_line_of_another_form_is_no_start(tmp_path, line):
    run_dir.write_origin(tmp_path, 0, engine="warp", num_envs=100)
    with (tmp_path / "origin.jsonl").open("a") as file:
        file.write(line + "\n")
    assert run_dir.count_samples(tmp_path, C, 10) == 10 * 100 * 24
    assert run_dir.last_engine(tmp_path) == "warp"
    (tmp_path / "origin.jsonl").write_text(line + "\n")
    assert run_dir.first_option(tmp_path, "experiment") is None


def test_a_start_that_came_to_no_iteration_is_forgotten(tmp_path):
    run_dir.write_origin(tmp_path, 0, engine="mjx")
    run_dir.write_origin(tmp_path, 0, engine="warp")
    assert len((tmp_path / "origin.jsonl").read_text().splitlines()) == 1


def test_settings_survive_a_full_disk(tmp_path, monkeypatch):
    run_dir.write_config(tmp_path, C)

    def fill_up(path, text):
        path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(run_dir.Path, "write_text", fill_up)
    with pytest.raises(OSError, match="No space left"):
        run_dir.write_config(tmp_path, C)
    assert run_dir.read_config(tmp_path) == C


def test_a_run_without_a_first_command_gave_no_option(tmp_path):
    assert run_dir.first_option(tmp_path, "experiment") is None


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """Return a repository of this program, whose one commit has the file that reads it."""
    file = tmp_path / "cref_jax" / "training" / "run_dir.py"
    file.parent.mkdir(parents=True)
    file.touch()
    monkeypatch.setattr(run_dir, "__file__", str(file))
    git = ["git", "-C", str(tmp_path), "-c", "user.name=A", "-c", "user.email=a@example.org"]
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "Begin"]):
        subprocess.run([*git, *words], check=True)
    return tmp_path


def test_only_changes_of_the_programs_own_files_mark_its_commit(repository):
    commit = run_dir._git_state()
    assert commit is not None and len(commit) == 40
    (repository / "eval.json").touch()
    assert run_dir._git_state() == commit
    (repository / "cref_jax" / "new.py").touch()
    assert run_dir._git_state() == commit + "+"


def test_an_installed_program_has_no_commit_of_the_repository_it_lies_below(
    repository, monkeypatch
):
    installed = repository / ".venv" / "cref_jax" / "training" / "run_dir.py"
    installed.parent.mkdir(parents=True)
    installed.touch()
    monkeypatch.setattr(run_dir, "__file__", str(installed))
    assert run_dir._git_state() is None
