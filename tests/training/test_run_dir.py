"""A run remembers the map that it began on, and the command."""

import json

import numpy as np
import pytest

from cref_jax.errors import ConfigError
from cref_jax.training import run_dir


@pytest.fixture
def hill(tmp_path):
    np.save(tmp_path / "hill.npy", np.zeros((20, 20)))
    (tmp_path / "hill.toml").write_text("cell = 0.1\nstart = [0.5, 1.0]\n")
    return tmp_path / "hill.npy"


@pytest.mark.parametrize("changed", ["hill.npy", "hill.toml"])
def test_a_map_that_has_changed_is_not_gone_on_with(tmp_path, hill, changed):
    run_dir.write_origin(tmp_path, 0, str(hill))
    run_dir.check_map(tmp_path, str(hill))
    (tmp_path / changed).write_bytes((tmp_path / changed).read_bytes() + b"\n")
    with pytest.raises(ConfigError, match=f"has changed since {tmp_path} began; .* --init"):
        run_dir.check_map(tmp_path, str(hill))


def test_a_terrain_that_is_no_map_leaves_no_digest(tmp_path):
    run_dir.write_origin(tmp_path, 0, "flat")
    assert "map" not in json.loads((tmp_path / "origin.jsonl").read_text())
    run_dir.check_map(tmp_path, "flat")
    run_dir.check_map(tmp_path / "nothing", "flat")


@pytest.mark.parametrize(
    ("command", "value"),
    [
        ([], None),
        (["train", "--seed", "3"], None),
        (["train", "--experiment", "robust", "--seed", "3"], "robust"),
        (["train", "--experiment=robust"], "robust"),
    ],
)
def test_an_option_is_read_from_the_command_that_began_a_run(tmp_path, command, value):
    (tmp_path / "origin.jsonl").write_text(json.dumps({"command": command}) + "\n{}\n")
    assert run_dir.first_option(tmp_path, "experiment") == value


def test_a_run_without_a_first_command_gave_no_option(tmp_path):
    assert run_dir.first_option(tmp_path, "experiment") is None
