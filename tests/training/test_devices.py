"""Where a run goes on, and over which devices its robots are sharded."""

import os
import subprocess
import sys
from unittest.mock import Mock

import jax
import pytest
from jax.sharding import Mesh

from cref_jax.config import presets
from cref_jax.errors import ConfigError
from cref_jax.system import jax_setup
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


SELECT = """
from cref_jax import cli
from cref_jax.training import devices
with cli.one_line_errors():
    devices.select_device("auto")
"""


@pytest.mark.slow
@pytest.mark.parametrize("platform", ["cuda", "tpu"])  # of which JAX says so in different ways
def test_a_platform_that_is_not_there_is_one_line_that_names_its_variable(platform):
    if platform == "cuda" and jax_setup.has_cuda_plugin():
        pytest.skip("this platform may be here")
    environment = {**os.environ, "JAX_PLATFORMS": platform}
    asked = [sys.executable, "-c", SELECT]
    done = subprocess.run(asked, capture_output=True, text=True, env=environment)
    said = done.stderr.splitlines()[-1]
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert said.startswith(f"error: JAX_PLATFORMS={platform}: JAX has no such device here")
