"""The script for a GPU that is at hand for minutes: what it says to who asks wrongly."""

import os
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
        (
            ["run", "out", "--profile", "--minutes", "1"],
            "error: --minutes must be at least 2, not 1",
        ),
        (["run"], "run needs a folder to write to"),
        (["pack"], "pack needs a folder"),
        (["pack", "new", "--python", "3.9"], "error: Python 3.9 is not tested; 3.11 and 3.12 are"),
    ],
)
def test_a_mistake_is_told_before_anything_is_done(arguments, says, tmp_path):
    done = subprocess.run(
        ["bash", str(SCRIPT), *arguments], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode != 0 and says in done.stdout + done.stderr
    assert list(tmp_path.iterdir()) == []


PYTHON = """#!/usr/bin/env bash
echo "$*" >> calls
if [[ "$*" == *cref_jax.train* ]]; then
  mkdir -p pack/run
  touch pack/run/{log.jsonl,config.json,origin.jsonl,stages.json}
  head -c ${TRACE_BYTES} /dev/zero > pack/run/trace.json.gz
fi
"""


@pytest.mark.parametrize(("size", "comes_back"), [(1000, True), (2 * 2**20 + 1, False)])
def test_a_profile_is_asked_of_training_and_its_trace_comes_back_if_small(
    size, comes_back, tmp_path
):
    for folder in ("pack", "bin"):
        (tmp_path / folder).mkdir()
    python = tmp_path / "bin" / "python3"
    python.write_text(PYTHON)
    python.chmod(0o755)
    script = tmp_path / "pack" / "gpu_run.sh"
    script.write_text(SCRIPT.read_text())
    asked = ["run", "out", "--mib", "2", "--profile", "--minutes", "2", "--", "--terrain", "gap"]
    environment = {**os.environ, "PATH": f"{python.parent}:{os.environ['PATH']}"}
    subprocess.run(
        ["bash", str(script), *asked],
        check=True,
        cwd=tmp_path,
        env={**environment, "TRACE_BYTES": str(size)},
    )
    calls = (tmp_path / "calls").read_text()
    assert "-m cref_jax.train --terrain gap --profile --run.chunk 2 --run-dir" in calls
    assert (tmp_path / "out" / "stages.json").exists()
    assert (tmp_path / "out" / "trace.json.gz").exists() == comes_back
