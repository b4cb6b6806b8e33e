"""A run remembers the map that it began on."""

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
