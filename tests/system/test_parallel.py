"""Work in several processes: the results are in order, and nothing outlives Ctrl-C."""

import functools
import multiprocessing
import operator
import os
import signal
import subprocess
import sys
import time

import pytest

from cref_jax.system import parallel

SLEEPERS = """
import functools, time
from cref_jax import cli
from cref_jax.system import parallel
with cli.one_line_errors():
    print("begun", flush=True)
    parallel.run(functools.partial, (time.sleep,), [600.0] * 4, 2)
"""


@pytest.mark.parametrize("count", [1, 2])
def test_results_are_in_the_order_of_the_jobs(count):
    # the worker is pow(2, job)
    make = functools.partial(functools.partial, operator.pow)
    assert parallel.run(make, (2,), [5, 1, 3], count) == [32, 2, 8]


def test_an_error_of_a_job_leaves_other_processes_of_the_caller_alone():
    own = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(600.0,))
    own.start()
    try:
        with pytest.raises(ZeroDivisionError):
            parallel.run(functools.partial, (operator.truediv, 1), [0, 0], 2)
        own.join(0.5)
        assert own.is_alive()
    finally:
        own.kill()


@pytest.mark.parametrize("seconds", [0.5, 6.0])  # while the workers start, and at their work
def test_ctrl_c_ends_all_of_them_without_a_traceback(seconds):
    heed = lambda: signal.signal(signal.SIGINT, signal.default_int_handler)
    parent = subprocess.Popen(
        [sys.executable, "-c", SLEEPERS],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        preexec_fn=heed,  # a shell's background jobs do not
    )
    assert parent.stdout is not None
    assert parent.stdout.readline() == "begun\n"
    time.sleep(seconds)
    os.killpg(parent.pid, signal.SIGINT)
    said, _ = parent.communicate(timeout=60)  # until all that can write there have ended
    assert parent.returncode == 130
    assert said.strip().endswith("interrupted") and "Error" not in said and "leaked" not in said
