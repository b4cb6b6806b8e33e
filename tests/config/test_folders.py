"""What is printed to be typed next."""

import shlex

import pytest

from cref_jax.config import folders


def test_a_next_step_is_quoted_for_the_shell_and_for_that_of_make():
    line = folders.command_line("play", "--run", "läufe/ä b")
    assert line == """make play ARGS="--run 'läufe/ä b'\""""


@pytest.mark.parametrize("name", ["a b", "a'b", 'a"b', "a$b", "a`b"])
def test_a_path_of_any_name_comes_through_both_shells(name):
    *_, given = shlex.split(folders.command_line("play", "--run", name))
    line = given.removeprefix("ARGS=").replace("$$", "$")  # as make does
    assert shlex.split(line) == ["--run", name]


def test_without_a_makefile_a_next_step_is_of_the_installed_command(monkeypatch, tmp_path):
    monkeypatch.setattr(folders, "PACKAGE", tmp_path / "cref_jax")
    assert folders.command_line("play", "--run", "a b") == "cref play --run 'a b'"
