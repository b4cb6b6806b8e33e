"""A checkpoint of version 0.1 still resumes, and what it then learns is what it learned then.

data/checkpoint/run is what this wrote, the smallest state with every kind of leaf:

    python -m cref_jax.train --run-dir run --terrain gap --experiment smoke --iterations 2 \
        --device cpu --devices 1 --no-tensorboard --no-evaluate --num-envs 2 --episode.length 0.2 \
        --ppo.horizon 8 --ppo.readout-weight 0.1 --ppo.mirror-weight 0.1 \
        --randomisation.enabled --randomisation.ramp --camera.shape 24 32 \
        --scan.x -0.2 0.8 3 --scan.y -0.2 0.2 3 --scan.ahead 0.0 0.6 4 \
        --network.convolutions 2 4 4 4 3 2 --network.token 4 --network.heads 2 \
        --network.compressed 4 --network.lstm 4 --network.gru 4 --network.actor 8 --network.critic 8

data/checkpoint/resumed.json is `sums` of the state one iteration later. Whoever changes on purpose
what is learned writes it anew; the run itself stays.
"""

import contextlib
import io
import json
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import orbax.checkpoint as ocp
import pytest

from cref_jax import train

DATA = Path(__file__).parents[1] / "data" / "checkpoint"
TOLERANCE = 1e-3  # of the sum of magnitudes; without AVX-512 or optimisation it is 1e-5

pytestmark = pytest.mark.slow


class Resumed(NamedTuple):
    run: Path
    said: str


@pytest.fixture(scope="module")
def resumed(tmp_path_factory: pytest.TempPathFactory) -> Resumed:
    """Return a copy of the run that has gone on for one iteration."""
    run = tmp_path_factory.mktemp("old") / "run"
    shutil.copytree(DATA / "run", run)
    arguments = ["--resume", "--run-dir", str(run), "--iterations", "3"]
    arguments += ["--device", "cpu", "--devices", "1", "--no-tensorboard", "--no-evaluate"]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        train.main(arguments)
    return Resumed(run, said.getvalue())


def kinds(run: Path, step: int) -> dict[str, tuple]:
    """Return shape, dtype and generator of every leaf, as the step's record has them."""
    file = run / "checkpoints" / str(step) / "meta" / "metadata"
    found = json.loads(file.read_text())["record"]["leaves"]
    return {name: (leaf["shape"], leaf["dtype"], leaf["impl"]) for name, leaf in found.items()}


def sums(run: Path, step: int) -> dict[str, list[float]]:
    """Return the sum of every leaf, and of its magnitudes, from the files alone."""
    path = (run / "checkpoints" / str(step)).absolute()
    with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as reader:
        state = reader.restore(path, ocp.args.Composite(state=ocp.args.PyTreeRestore())).state
    of = lambda x: [float(x.sum()), float(np.abs(x).sum())]
    return {name: of(np.asarray(leaf, np.float64)) for name, leaf in sorted(state.items())}


def differing(here: dict[str, list[float]], there: dict[str, list[float]]) -> list[str]:
    """Return the leaves whose sums differ by more than another CPU accounts for."""
    far = lambda a, b: np.abs(np.subtract(a, b)).max() > TOLERANCE * b[1]
    return [name for name in there if far(here[name], there[name])]


def test_it_goes_on_from_where_it_was(resumed: Resumed):
    assert "iterations 3, from iteration 2" in resumed.said
    assert "the robots start anew" not in resumed.said
    log = [json.loads(line) for line in (resumed.run / "log.jsonl").open()]
    assert [line["iteration"] for line in log] == [3]


def test_every_leaf_keeps_its_path_shape_and_dtype(resumed: Resumed):
    before, after = kinds(resumed.run, 2), kinds(resumed.run, 3)
    assert len(before) == 285 and before == after


def test_what_it_learns_is_what_it_learned_then(resumed: Resumed):
    then, here = json.loads((DATA / "resumed.json").read_text()), sums(resumed.run, 3)
    assert here.keys() == then.keys() and differing(here, then) == []
    whole = [name for name, (_, dtype, _) in kinds(DATA / "run", 2).items() if "float" not in dtype]
    assert {name: here[name] for name in whole} == {name: then[name] for name in whole}


def test_an_iteration_that_was_not_learned_would_be_noticed():
    then, stored = json.loads((DATA / "resumed.json").read_text()), sums(DATA / "run", 2)
    moments = {name for name in then if "/mu/" in name or "/nu/" in name}  # of Adam
    assert moments and moments <= set(differing(stored, then))
