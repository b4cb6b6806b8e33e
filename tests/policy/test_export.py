import dataclasses
import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tiny_policy import ROBOT, SMALL, J, policy, recorded

from cref_jax import config, deploy, export, play, report, robot, sim2sim
from cref_jax import eval as eval_command
from cref_jax.errors import ConfigError
from cref_jax.policy import reader, reference_vectors, runtime_file, sources, writer
from cref_jax.policy.manifest import build_manifest
from cref_jax.robot.registry import describe
from cref_jax.runtime import network


@pytest.fixture
def small_world(world):
    c = dataclasses.replace(world.config, network=SMALL)
    return world.replace(config=c)


def trained(world):
    return policy("full")._replace(config=world.config)


@pytest.fixture
def directory(small_world, tmp_path):
    writer.write(trained(small_world), small_world, tmp_path / "policy")
    return tmp_path / "policy"


@pytest.mark.slow
def test_a_directory_tests_itself_on_a_machine_with_nothing_but_numpy(directory):
    assert sorted(path.name for path in directory.iterdir()) == [
        "cref_policy.c", "cref_policy.h", "cref_runtime.py", "manifest.json", "testvectors.npz",
        "weights.npz",
    ]  # fmt: skip
    blocked = "import sys, runpy; sys.modules['jax'] = sys.modules['mujoco'] = None; "
    for target in (directory, directory.with_name("policy.zip")):
        arguments = f"sys.argv = ['x', '--selftest', {str(target)!r}]; "
        run = f"runpy.run_path({str(directory / 'cref_runtime.py')!r}, run_name='__main__')"
        done = subprocess.run(
            [sys.executable, "-c", blocked + arguments + run], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        assert "p99" in done.stdout


@pytest.mark.slow
def test_a_runtime_that_says_something_else_fails_its_test(directory, monkeypatch):
    monkeypatch.setattr(network._Fusion, "__call__", lambda self, x: np.copyto(self.out, x) or x)
    with pytest.raises(deploy.PolicyFormatError, match="differs from training"):
        deploy.self_test(directory)


@pytest.mark.slow
def test_the_vectors_hold_a_reset_a_frame_with_holes_and_the_true_rate(small_world):
    found = reference_vectors.build_test_vectors(small_world, trained(small_world).train)
    assert found["reset"].sum() == 2 and found["reset"][reference_vectors.STEPS // 2]
    assert set(np.diff(found["frame_step"][:10])) == {2, 3}
    holed = found["frames"][reference_vectors.HOLED]
    assert np.isnan(holed).any() and (holed == 0.0).any()
    assert np.abs(found["expect/attention"]).max() > 0.0
    np.testing.assert_allclose(found["now"][found["frame_step"]] - found["stamps"], 0.02)


@pytest.mark.slow
def test_the_vectors_are_of_a_robot_with_nothing_randomised(small_world):
    ranges = {"enabled": True, "joint_offset": 0.5, "noise_gravity": 0.5, "structures": 8}
    c = config.override(small_world.config, {"randomisation": ranges})
    train = trained(small_world).train
    found, expected = (
        reference_vectors.build_test_vectors(world, train)
        for world in (small_world.replace(config=c), small_world)
    )
    for name, x in expected.items():
        np.testing.assert_array_equal(found[name], x, err_msg=name)


@pytest.mark.slow
def test_a_policy_comes_back_as_it_went(directory, small_world):
    was, found = trained(small_world), reader.read(directory, small_world)
    assert found.config == was.config and found.iteration == was.iteration
    steps = recorded(20)
    say = lambda train: reference_vectors.compute_reference(
        SMALL, train, ROBOT, was.config.robot, steps
    )
    np.testing.assert_array_equal(say(found.train)["action"], say(was.train)["action"])


def test_the_manifest_has_the_command_and_no_one_s_folders(tmp_path):
    words = ["/home/someone/train.py", "--terrain", "gap", "--run-dir", "/home/someone/runs/gap"]
    words += ["--distillation.teachers", "gap=/home/someone/runs/A", "flat:0-2=runs/B"]
    (tmp_path / "origin.jsonl").write_text(json.dumps({"command": words}) + "\n")
    ours = policy("full")._replace(run=tmp_path)
    taught = config.override(ours.config, {"distillation": {"teachers": words[-2:]}})
    manifest = build_manifest(ours._replace(config=taught), ROBOT)
    command = manifest["provenance"]["trained_by"]["command"]
    assert command[:5] == ["train.py", "--terrain", "gap", "--run-dir", "gap"]
    teachers = manifest["provenance"]["config"]["distillation"]["teachers"]
    assert teachers == command[6:] == ["gap=A", "flat:0-2=runs/B"]
    (tmp_path / "origin.jsonl").write_text('{"command": 5}\n')
    manifest = build_manifest(policy("full")._replace(run=tmp_path), ROBOT)
    assert manifest["provenance"]["trained_by"] == {"command": []}


@pytest.mark.parametrize("name", robot.ROBOTS)
def test_the_manifest_says_what_the_engineer_needs(name):
    driven = robot.load(config.Robot(name))
    manifest = build_manifest(policy("full", name=name), driven)
    assert manifest["robot"] == name
    assert [joint["name"] for joint in manifest["joints"]] == list(driven.joint_names)
    whole = robot.load(config.Robot(name, actuated="all"))
    held = {joint["name"] for joint in manifest["held_joints"]}
    assert held == set(whole.joint_names) - set(driven.joint_names)
    assert [term["name"] for term in manifest["observation"]["terms"]] == list(deploy.TERMS)
    assert sum(term["size"] for term in manifest["observation"]["terms"]) == 9 + 3 * J
    assert len(manifest["observation"]["mean"]) == 9 + 3 * J
    assert f'<body name="{manifest["depth"]["mount"]["link"]}"' in describe(name).xml.read_text()
    assert manifest["depth"]["mount"]["pitch_deg"] == describe(name).camera_pitch
    assert manifest["rates"] == {"control_hz": 50.0, "depth_hz": 20.0, "frame_age_s": 0.02}
    json.dumps(manifest, allow_nan=False)


def test_numbers_survive_the_text_to_the_last_bit():
    manifest = json.loads(json.dumps(build_manifest(policy("full"), ROBOT)))
    mean = np.asarray(policy("full").train.statistics.obs.mean)
    np.testing.assert_array_equal(np.array(manifest["observation"]["mean"], np.float32), mean)
    kp = [joint["kp"] for joint in manifest["joints"]]
    np.testing.assert_array_equal(np.array(kp, np.float32), ROBOT.kp)


def test_a_run_and_a_policy_exclude_each_other(tmp_path):
    with pytest.raises(ConfigError, match="not both"):
        sources.resolve_policy(tmp_path, tmp_path)
    assert sources.resolve_policy(None, tmp_path) == tmp_path


def test_without_a_run_the_bundled_policy_is_taken(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert sources.resolve_policy(None, None) == sources.bundled_policy()
    assert not sources.is_run(sources.bundled_policy())


def runs_of(root: Path, **robots: str) -> None:
    """Make a run of one checkpoint for each robot, the later the newer."""
    for number, (run, robot_name) in enumerate(robots.items()):
        (root / run / "checkpoints" / "1" / "state").mkdir(parents=True)
        (root / run / "config.json").write_text(json.dumps({"robot": {"name": robot_name}}))
        os.utime(root / run / "checkpoints", (number, number))


def test_the_newest_run_is_that_of_the_robot(tmp_path, monkeypatch):
    runs_of(tmp_path / "runs", a="g1", b="g1", c="x2_ultra")
    monkeypatch.chdir(tmp_path)
    newest = lambda name: sources.resolve_policy(None, None, name)
    assert [newest(name) for name in (None, "x2_ultra", "g1")] == [
        Path("runs/c"), Path("runs/c"), Path("runs/b"),
    ]  # fmt: skip
    with pytest.raises(ConfigError, match="runs/c is of the robot 'x2_ultra', not of 'g1'"):
        sources.resolve_policy(Path("runs/c"), None, "g1")
    with pytest.raises(ConfigError, match="unknown robot 'g2'; known: g1, x2_ultra"):
        newest("g2")


def test_a_run_that_cannot_be_read_hides_no_other_run(tmp_path, monkeypatch, capsys):
    runs_of(tmp_path / "runs", a="g1", b="x2_ultra", c="g1")
    (tmp_path / "runs" / "c" / "config.json").write_text("{")
    monkeypatch.chdir(tmp_path)
    for name, run in (("x2_ultra", "runs/b"), ("g1", "runs/a")):
        assert sources.resolve_policy(None, None, name) == Path(run)
        said = capsys.readouterr().err
        assert said.startswith("runs/c is left out: runs/c/config.json") and said.count("\n") == 1


def test_without_a_run_of_the_robot_its_training_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert sources.resolve_policy(None, None, "x2_ultra") == sources.bundled_policy()
    with pytest.raises(ConfigError, match=r"no trained run of 'g1' .* flat --robot g1\""):
        sources.resolve_policy(None, None, "g1")


@pytest.mark.parametrize("command", [eval_command, play, export, sim2sim, report])
def test_every_command_refuses_another_robots_policy(command, capsys):
    given = "--run" if command is export else "--policy"
    with pytest.raises(SystemExit) as end:
        command.main([given, str(sources.bundled_policy()), "--robot", "g1"])
    said = capsys.readouterr().err
    assert end.value.code == 2 and said.count("\n") == 1
    assert "is of the robot 'x2_ultra', not of 'g1'" in said


def test_what_was_learned_is_not_in_an_exported_policy(capsys, tmp_path):
    with pytest.raises(SystemExit) as end:
        export.main(["--policy", "robust", "--learner", str(tmp_path / "learned.npz")])
    assert end.value.code == 2 and not list(tmp_path.iterdir())
    assert capsys.readouterr().err == (
        "error: --learner goes with --run: an exported policy has no critic\n"
    )


def test_a_policy_in_the_world_of_another_robot_is_refused(small_world):
    c = robot.fill_in(dataclasses.replace(small_world.config, robot=config.Robot("g1")))
    with pytest.raises(ConfigError, match="is of the robot 'x2_ultra', not of 'g1'"):
        sources.load(sources.bundled_policy(), small_world.replace(config=c))


def test_what_is_no_policy_is_one_line(tmp_path):
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(ConfigError, match="has no 'format'"):
        sources.read_config(tmp_path)


def test_the_bundled_policy_is_whole_and_small_enough():
    deploy.self_test(sources.bundled_policy(), rounds=1)
    files = list(sources.bundled_policy().iterdir())
    assert sum(file.stat().st_size for file in files) < 10e6


@pytest.mark.parametrize("damage", [Path.unlink, lambda path: path.write_bytes(b"PK")])
def test_test_vectors_that_cannot_be_read_are_those_of_a_folder(tmp_path, damage):
    shutil.copytree(sources.bundled_policy(), tmp_path / "policy")
    damage(tmp_path / "policy" / "testvectors.npz")
    with pytest.raises(deploy.PolicyFormatError, match=f"^{tmp_path}/policy: .*testvectors.npz"):
        deploy.self_test(tmp_path / "policy", rounds=1)


def test_an_exported_policy_is_written_again_with_this_versions_runtime(tmp_path):
    writer.copy(sources.bundled_policy(), tmp_path / "policy")
    runtime = (tmp_path / "policy" / "cref_runtime.py").read_bytes()
    assert runtime == runtime_file.join_files()
    deploy.self_test(tmp_path / "policy.zip", rounds=1)
    before, after = (
        reader.read_contents(p)[0] for p in (sources.bundled_policy(), tmp_path / "policy")
    )
    changed = {"files", "digest"}
    assert {k: v for k, v in before.items() if k not in changed} == {
        k: v for k, v in after.items() if k not in changed
    }


def test_a_full_disk_leaves_the_export_before_and_names_the_file(tmp_path, monkeypatch):
    out = tmp_path / "policy"
    writer.copy(sources.bundled_policy(), out)
    bytes_of = lambda: {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    before, write = bytes_of(), Path.write_bytes

    def fill_up(path, data):
        write(path, data[: len(data) // 2])
        if path.name.startswith("cref_policy.c"):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fill_up)
    with pytest.raises(ConfigError, match=f"cannot write {out}/cref_policy.c: No space left"):
        writer.copy(sources.bundled_policy("robust"), out)
    assert bytes_of() == before


def test_a_policy_without_files_in_c_leaves_none_of_the_one_before(tmp_path, monkeypatch):
    writer.copy(sources.bundled_policy(), tmp_path / "policy")
    monkeypatch.setattr(writer.c_files, "VARIANTS", ())
    writer.copy(sources.bundled_policy(), tmp_path / "policy")
    assert not list((tmp_path / "policy").glob("cref_policy.*"))


def test_the_files_in_c_have_digests_and_are_not_needed_by_the_runtime(tmp_path):
    writer.copy(sources.bundled_policy(), tmp_path / "policy")
    digests = reader.read_contents(tmp_path / "policy")[0]["files"]
    for name in ("cref_policy.c", "cref_policy.h"):
        file = tmp_path / "policy" / name
        assert digests[name] == hashlib.sha256(file.read_bytes()).hexdigest()
        file.unlink()
    deploy.self_test(tmp_path / "policy", rounds=1)


def test_a_bundled_policy_is_found_by_its_name_where_there_is_no_such_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert sources.resolve_policy(None, Path("robust")) == sources.bundled_policy("robust")
    assert sources.find_policy(Path("no such policy")) == Path("no such policy")
    (tmp_path / "robust").mkdir()
    assert sources.find_policy(Path("robust")) == Path("robust")


@pytest.mark.parametrize("name", ["combined", "mixed", "robust"])  # one has a ray per pixel
def test_a_bundled_policy_says_what_it_said_in_training(name):
    deploy.self_test(sources.bundled_policy(name))
