"""What a run prints and logs while it trains."""

import numpy as np
import pytest

from cref_jax.pages import training_log
from cref_jax.training.progress import Reporter


@pytest.mark.parametrize("line", ["runs/exp[gap]/seed1: begins", "error in [/usr/lib]"])
def test_a_line_is_printed_as_it_is(tmp_path, capsys, line):
    with Reporter(tmp_path, 0, 1, 1, tensorboard=False) as reporter:
        reporter.say(line)
    assert capsys.readouterr().out == line + "\n"


def test_a_cut_last_line_of_the_log_loses_that_iteration_alone(tmp_path):
    for first in (0, 2):
        with Reporter(tmp_path, first, 4, 8, tensorboard=False) as reporter:
            reporter.chunk(first, {"loss/kl": np.zeros(2)}, 1.0)
        if not first:
            log = tmp_path / "log.jsonl"
            log.write_bytes(log.read_bytes()[:-5])
    found = training_log.read(tmp_path / "log.jsonl")
    assert (list(found["iteration"]), found.damaged) == ([1, 3, 4], 1)
