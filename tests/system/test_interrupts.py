"""A request to stop is taken once, and not at all under nohup."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from cref_jax.system import interrupts
from cref_jax.system.interrupts import StopRequest


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_signal_is_a_request_and_handlers_come_back(capsys, number):
    before = signal.getsignal(number)
    with StopRequest() as stop:
        assert not stop.requested
        os.kill(os.getpid(), number)
        assert stop.requested
    assert signal.getsignal(number) == before
    assert "saving, then stopping" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_that_comes_twice_at_once_is_one_request(number):
    with StopRequest() as stop:
        for _ in range(2):
            os.kill(os.getpid(), number)
            time.sleep(0.0003)
        assert stop.requested


def test_a_second_ctrl_c_is_an_interrupt_that_a_notebook_survives(monkeypatch):
    monkeypatch.setattr(interrupts, "ONE_REQUEST", 0.0)
    with pytest.raises(KeyboardInterrupt), StopRequest():
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)


def test_a_second_sigterm_ends_the_program_at_once():
    program = (
        "import os, signal, time\n"
        "from cref_jax.system.interrupts import StopRequest\n"
        "with StopRequest():\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    time.sleep(1.0)\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "print('still here')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True)
    assert (done.returncode, done.stdout) == (128 + signal.SIGTERM, b"")


def test_a_program_under_nohup_goes_on_when_the_terminal_is_gone():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopRequest() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.requested
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_request_is_not_lost_with_the_terminal(monkeypatch):
    def gone(text: str) -> int:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(sys.stderr, "write", gone)
    with StopRequest() as stop:
        os.kill(os.getpid(), signal.SIGHUP)
        assert stop.requested


def test_another_thread_trains_without_signals():
    entered = []

    def enter() -> None:
        with StopRequest() as stop:
            entered.append(stop.requested)

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert entered == [False]
