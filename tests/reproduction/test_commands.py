"""Commands as processes: signals are passed on to them, and they end with this process."""

import signal
import subprocess
import sys
import time

import pytest

from cref_jax.reproduction import commands
from cref_jax.reproduction.commands import Runner

SAVES = """
import signal, sys, time
def save(number, frame):
    print("saved", flush=True)
    sys.exit(3)
signal.signal(signal.SIGINT, save)
signal.signal(signal.SIGTERM, save)
print("trains", flush=True)
time.sleep(60)
"""
TIE = """
import threading
from cref_jax.system import tied
threading.Thread(target=tied._end_with_input, daemon=True).start()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_passed_on_and_the_command_saves(monkeypatch, capfd, number):
    monkeypatch.setattr(commands, "START", (sys.executable, "-c", SAVES))
    monkeypatch.setattr(commands, "PAUSE", 0.05)
    before = signal.getsignal(number)
    said = ""

    def once_it_trains():
        nonlocal said
        said += capfd.readouterr().out
        if "trains" in said and runner.signal is None:
            signal.raise_signal(number)

    with Runner() as runner:
        assert runner.run(["train"], once_it_trains) == 3
        assert runner.signal == number
    assert "saved" in said + capfd.readouterr().out
    assert signal.getsignal(number) is before


def test_a_command_saves_where_its_progress_cannot_be_said(monkeypatch, capfd):
    monkeypatch.setattr(commands, "START", (sys.executable, "-c", TIE + SAVES))
    monkeypatch.setattr(commands, "PAUSE", 0.05)
    said = ""

    def once_it_trains():
        nonlocal said
        said += capfd.readouterr().out
        if "trains" in said:
            raise BrokenPipeError

    with Runner() as runner, pytest.raises(BrokenPipeError):
        runner.run(["train"], once_it_trains)
    assert "saved" in capfd.readouterr().out


def test_a_variable_of_the_runner_is_one_of_its_commands(monkeypatch, capfd):
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    program = "import os; print(os.environ['JAX_PLATFORMS'], 'HOME' in os.environ)"
    monkeypatch.setattr(commands, "START", (sys.executable, "-c", program))
    with Runner(JAX_PLATFORMS="cpu") as runner:
        assert runner.run(["eval"]) == 0
    assert capfd.readouterr().out == "cpu True\n"


def test_a_signal_that_came_between_two_commands_ends_the_next_one(monkeypatch):
    monkeypatch.setattr(commands, "START", (sys.executable, "-c", "import time; time.sleep(60)"))
    with Runner() as runner:
        signal.raise_signal(signal.SIGTERM)
        assert runner.run(["train"]) == -signal.SIGTERM


def test_a_command_ends_with_the_process_that_started_it():
    child = subprocess.Popen(
        [sys.executable, "-c", TIE + SAVES],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdin and child.stdout
    assert child.stdout.readline() == "trains\n"
    time.sleep(0.1)
    assert child.poll() is None
    child.stdin.close()  # as the kernel does when the parent dies
    assert child.wait(30) == 1


def test_a_command_is_the_one_that_cref_runs(capfd):
    with Runner() as runner:
        assert runner.run(["nonsense"]) == 2
    assert "unknown command 'nonsense'" in capfd.readouterr().err
