"""What all commands share: errors of one line, and files that can be written."""

import importlib
import os
import subprocess
import sys
import typing
from typing import Any

import pytest
from test_layers import COMMANDS

from cref_jax import cli
from cref_jax.config.ranges import declared_ranges
from cref_jax.errors import ConfigError, TrainingError


@pytest.mark.parametrize(("error", "code"), [(ConfigError("no"), 2), (TrainingError("no"), 1)])
def test_what_a_user_can_mend_is_one_line(capsys, error, code):
    with pytest.raises(SystemExit) as end, cli.one_line_errors():
        raise error
    assert end.value.code == code and capsys.readouterr().err == "error: no\n"
    with pytest.raises(type(error)), cli.one_line_errors(["--debug"]):
        raise error


def test_ctrl_c_leaves_a_program_that_calls_a_command_alive():
    with pytest.raises(KeyboardInterrupt), cli.one_line_errors([]):
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (PermissionError(13, "Permission denied", "runs/a"), "runs/a: Permission denied"),
        (OSError(28, "No space left on device"), "No space left on device"),
        (ConfigError("no file a\nb"), "no file a b"),
    ],
)
def test_what_the_system_refuses_is_one_line_with_the_file(capsys, error, says):
    with pytest.raises(SystemExit) as end, cli.one_line_errors([]):
        raise error
    assert end.value.code == 2 and capsys.readouterr().err == f"error: {says}\n"


def test_a_terminal_of_few_characters_loses_no_result():
    program = "from cref_jax import cli\nwith cli.one_line_errors(): print('runs/Tür: 3 m')"
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )
    assert (done.returncode, done.stdout) == (0, b"runs/T?r: 3 m\n")


@pytest.mark.parametrize("ends", ["pass", "sys.exit(0)"])  # as after --help
@pytest.mark.parametrize("lines", [1, 100_000])  # fewer and more than a pipe holds
def test_a_command_ends_quietly_when_nobody_reads_its_output(ends, lines):
    program = (
        "import sys\n"
        "from cref_jax import cli\n"
        "with cli.one_line_errors():\n"
        "    sys.stdin.read()\n"
        f"    for number in range({lines}): print(number)\n"
        f"    {ends}\n"
    )
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=pipe, stdout=pipe, stderr=pipe
    ) as run:
        assert run.stdin and run.stdout and run.stderr
        run.stdout.close()
        run.stdin.close()
        assert (run.wait(timeout=60), run.stderr.read()) == (141, b"")


CHECKED_ELSEWHERE = {  # short for settings, or bounded by the machine or the terrain
    "train": {"num_envs", "iterations", "seed", "devices", "num_processes", "process_id"},
    "play": {"level"},
}


@pytest.mark.parametrize("command", sorted(COMMANDS - {"__main__"}))  # the door has no options
def test_every_number_of_every_command_has_a_range(command):
    options = importlib.import_module(f"cref_jax.{command}").Options
    hints = typing.get_type_hints(options)
    numbers = {name for name, hint in hints.items() if holds_numbers(hint)}
    assert numbers - CHECKED_ELSEWHERE.get(command, set()) <= declared_ranges(options).keys()


def holds_numbers(hint: Any) -> bool:
    """Check whether a type is a number or made of some."""
    return hint in (int, float) or any(map(holds_numbers, typing.get_args(hint)))


@pytest.mark.parametrize(
    ("command", "arguments", "says"),
    [
        ("eval", ["--num-envs", "0"], "--num-envs must be 1 to 1000000, not 0"),
        ("eval", ["--size", "nan"], "--size must be 0 to 100, not nan"),
        ("sim2sim", ["--trials", "-1"], "--trials must be 1 to 1000000, not -1"),
        ("sim2sim", ["--latency", "inf"], "--latency must be 0.02 to 10, not inf"),
        ("sim2sim", ["--latency", "0"], "--latency must be 0.02 to 10, not 0.0"),
        ("play", ["--seed", "4294967296"], "--seed must be 0 to 4294967295, not 4294967296"),
        ("bench", ["--num-envs", "8", "0"], "--num-envs must be 1 to 1000000, not 8 0"),
        ("gpu_program", ["--num-envs", "-4"], "--num-envs must be 1 to 1000000, not -4"),
    ],
)
def test_a_number_out_of_its_range_is_one_line(capsys, command, arguments, says):
    with pytest.raises(SystemExit) as end:
        importlib.import_module(f"cref_jax.{command}").main(arguments)
    assert end.value.code == 2 and capsys.readouterr().err == f"error: {says}\n"


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["--seed", "1", "--run", ""], "--run"),
        (["--run=", "--seed", "1"], "--run"),
        ([""], "an argument"),
    ],
)
def test_an_empty_value_is_a_shell_variable_that_is_not_set(capsys, arguments, option):
    for command in ("eval", "train"):
        with pytest.raises(SystemExit) as end:
            importlib.import_module(f"cref_jax.{command}").main(arguments)
        said = f"error: {option} is empty; is a shell variable not set?\n"
        assert end.value.code == 2 and capsys.readouterr().err == said


@pytest.mark.parametrize(
    ("command", "option", "name"),
    [
        ("eval", "--out", "results"),
        ("play", "--out", "play.mp4"),
        ("export", "--out", "policy"),
        ("export", "--learner", "learned.npz"),
        ("sim2sim", "--out", "result.json"),
        ("sim2sim", "--film", "film.mp4"),
        ("report", "--out", "page.html"),
        ("bench", "--out", "bench.json"),
    ],
)
def test_a_result_that_cannot_be_written_is_refused_before_the_work(
    tmp_path, monkeypatch, capsys, command, option, name
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as end:
        importlib.import_module(f"cref_jax.{command}").main([option, f"file/{name}"])
    said = capsys.readouterr()
    assert (end.value.code, said.out) == (2, "")
    assert said.err.startswith("error: cannot make the folder file") and said.err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_file_to_write_gets_its_folder_and_must_end_right(tmp_path):
    out = cli.prepare_output(tmp_path / "new" / "a.json", ".json")
    assert out.parent.is_dir()
    with pytest.raises(ConfigError, match=r"--out must end in \.json"):
        cli.prepare_output(tmp_path / "a.txt", ".json")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot make the folder"):
        cli.prepare_output(tmp_path / "file" / "a.json", ".json")
