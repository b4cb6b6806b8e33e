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


OWN_PYTHON = """#!/usr/bin/env bash
echo "$3 $4 ${*: -1}" >> "$(dirname "$0")/calls"
if [ "$4" = wheel ]; then touch "${*: -2:1}/cref_jax-1-py3-none-any.whl"; fi
"""


def test_a_folder_whose_name_has_spaces_is_packed(tmp_path):
    root = tmp_path / "my project"
    for folder in ("experiments", "constraints", ".venv/bin"):
        (root / folder).mkdir(parents=True)
    (root / "constraints" / "py312.txt").touch()
    script = root / "experiments" / "gpu_run.sh"
    script.write_text(SCRIPT.read_text())
    python = root / ".venv" / "bin" / "python"
    python.write_text(OWN_PYTHON)
    python.chmod(0o755)
    subprocess.run(["bash", str(script), "pack", "a pack"], check=True, cwd=tmp_path)
    calls = (python.parent / "calls").read_text().splitlines()
    assert [call.partition("-check ")[2] for call in calls] == [
        f"wheel {root}", "download a pack/cref_jax-1-py3-none-any.whl[warp]",
    ]  # fmt: skip
    assert (tmp_path / "a pack" / "gpu_run.sh").exists()


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
