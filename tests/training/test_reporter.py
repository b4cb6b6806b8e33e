"""What a run prints while it trains."""

import pytest

from cref_jax.training.progress import Reporter


@pytest.mark.parametrize("line", ["runs/exp[gap]/seed1: begins", "error in [/usr/lib]"])
def test_a_line_is_printed_as_it_is(tmp_path, capsys, line):
    with Reporter(tmp_path, 0, 1, 1, tensorboard=False) as reporter:
        reporter.say(line)
    assert capsys.readouterr().out == line + "\n"
