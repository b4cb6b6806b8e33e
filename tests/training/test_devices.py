"""Over which devices the robots of a run are sharded."""

from unittest.mock import Mock

import jax
import pytest
from jax.sharding import Mesh

from cref_jax.config import presets
from cref_jax.errors import ConfigError
from cref_jax.training import devices

MIXED = presets.build_config("mixed", None, "cpu")  # 256 robots, 4 minibatches, 14 turns of kinds


@pytest.fixture
def machine(monkeypatch):
    """Return a function that puts this many devices and processes here."""

    def put(count, processes=1):
        monkeypatch.setattr(jax, "device_count", lambda: count)
        monkeypatch.setattr(jax, "process_count", lambda: processes)

    monkeypatch.setattr(devices.iteration, "make_mesh", lambda n: Mock(Mesh, size=n))
    return put


@pytest.mark.parametrize(
    ("terrain", "cores", "chosen"),
    [
        # 256 robots: 8 devices have 32 each, 16 have 16; 32 would have 8, fewer than the 14 turns
        ("mixed", 2, 2),
        ("mixed", 8, 8),
        ("mixed", 64, 16),
        ("flat", 64, 64),  # one kind
    ],
)
def test_every_device_has_robots_for_each_kind_of_lane(machine, terrain, cores, chosen):
    machine(cores)
    assert devices.choose_mesh(presets.build_config(terrain, None, "cpu")).size == chosen


def test_more_devices_than_that_are_refused(machine):
    machine(64)
    says = "--devices 32: 256 robots .* over 1, 2, 4, 8, 16 of the 64 .*, 14 and more on each for"
    with pytest.raises(ConfigError, match=says):
        devices.choose_mesh(MIXED, 32)


def test_of_several_processes_none_is_left_out(machine):
    machine(4, processes=2)
    assert devices.choose_mesh(MIXED).size == 4
    with pytest.raises(ConfigError, match="--devices 2: several processes train on all of their 4"):
        devices.choose_mesh(MIXED, 2)
