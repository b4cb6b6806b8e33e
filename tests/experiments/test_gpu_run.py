"""The script for a GPU that is at hand for minutes: what it says to who asks wrongly."""

import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "experiments" / "gpu_run.sh"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "gpu_run.sh run out --minutes 9 -- --terrain mixed"),
        (["run", "out", "--minute", "9"], "error: unknown option --minute; known: --minutes"),
        (["run", "out", "--minutes", "1"], "error: --minutes must be at least 2, not 1"),
        (["run"], "run needs a folder to write to"),
        (["pack"], "pack needs a folder"),
    ],
)
def test_a_mistake_is_told_before_anything_is_done(arguments, says, tmp_path):
    done = subprocess.run(
        ["bash", str(SCRIPT), *arguments], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode != 0 and says in done.stdout + done.stderr
    assert list(tmp_path.iterdir()) == []
