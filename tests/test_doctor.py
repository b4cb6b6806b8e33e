"""The check of a machine, and the door to all commands."""

import importlib.metadata
import runpy
import subprocess
import sys

import pytest

from cref_jax import __main__ as door
from cref_jax import doctor


@pytest.mark.slow
def test_a_machine_that_runs_these_tests_is_right():
    asked = [sys.executable, "-m", "cref_jax", "doctor"]
    done = subprocess.run(asked, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    for name in doctor.CHECKS:
        assert f" {name} " in done.stdout
    assert "WRONG" not in done.stdout and "100.0 % of the pixels" in done.stdout


@pytest.mark.slow
def test_a_platform_that_is_not_there_is_said():
    asked = [sys.executable, "-m", "cref_jax.doctor"]
    environment = {**doctor.os.environ, "JAX_PLATFORMS": "tpu"}
    done = subprocess.run(asked, capture_output=True, text=True, env=environment)
    assert done.returncode == 1 and "no device ('tpu')" in done.stdout, done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("needed", "said", "prevents"),
    [
        ("numpy<1", "pip install", True),
        ("no-such-package>=2", "no-such-package is missing", True),
        ("no-such-package>=2; extra == 'dev'", "all as tested", False),
    ],
)
def test_a_package_of_another_version_is_named(monkeypatch, needed, said, prevents):
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: [needed])
    monkeypatch.setattr(doctor, "_read_tested", dict)
    (finding, *_) = doctor.check_packages()
    assert said in f"{finding.said} {finding.cure}" and finding.prevents == prevents


def test_a_version_that_was_not_tested_is_a_note(monkeypatch):
    monkeypatch.setattr(doctor, "_read_tested", lambda: {"rich": "1.0"})
    (finding,) = doctor.check_packages()
    assert "(1.0)" in finding.said and finding.cure and not finding.prevents


def test_a_damaged_bundled_policy_prevents(monkeypatch, tmp_path):
    (tmp_path / "manifest.json").write_text("{")
    monkeypatch.setattr(doctor.sources, "bundled_policy", lambda: tmp_path)
    (finding,) = doctor.check_runtime()
    assert "JSONDecodeError" in finding.said and finding.cure and finding.prevents


def test_the_door_lists_every_command_with_what_it_does(capsys):
    door.main([])
    said = capsys.readouterr().out
    for name in (*door.COMMANDS, "demo"):
        (line,) = [line for line in said.splitlines() if line.split()[:1] == [name]]
        assert len(line.split()) > 3 and line.endswith(".")


def test_a_misspelt_command_is_one_line(capsys):
    with pytest.raises(SystemExit) as end:
        door.main(["trian"])
    assert end.value.code == 2
    assert capsys.readouterr().err == "error: unknown command 'trian'; did you mean train?\n"


@pytest.mark.parametrize(
    ("asked", "module", "rest"),
    [
        (["eval", "--suite", "walk"], "cref_jax.eval", ["--suite", "walk"]),
        (["gpu-program"], "cref_jax.gpu_program", []),
        (["demo", "--seed", "1"], "cref_jax.play", [*door.DEMO[1:], "--seed", "1"]),
    ],
)
def test_a_command_is_the_module_of_its_name(monkeypatch, asked, module, rest):
    ran = []
    monkeypatch.setattr(sys, "argv", ["cref", *asked])
    monkeypatch.setattr(runpy, "run_module", lambda name, **_: ran.append((name, sys.argv[1:])))
    door.main()
    assert ran == [(module, rest)]
