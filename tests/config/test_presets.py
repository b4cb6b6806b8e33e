"""What a run checks and composes before it begins."""

import mmap
from types import SimpleNamespace
from unittest.mock import Mock

import jax
import pytest

from cref_jax.config import presets
from cref_jax.errors import ConfigError
from cref_jax.training import devices

GIB = 2**30


def program(arguments, temporary, output=0, alias=0):
    sizes = SimpleNamespace(
        argument_size_in_bytes=arguments,
        temp_size_in_bytes=temporary,
        output_size_in_bytes=output,
        alias_size_in_bytes=alias,
    )
    compiled = Mock(spec=jax.stages.Compiled)
    compiled.memory_analysis.return_value = sizes
    return compiled


def test_memory_is_what_goes_in_what_comes_out_and_what_lies_between(monkeypatch):
    monkeypatch.setattr(devices, "main_memory", lambda: 64 * GIB)
    monkeypatch.setattr(devices, "_resident_memory", lambda: 2 * GIB)
    # the output takes the place of the state that went in; the process holds 2 GiB without it
    two = program(2 * GIB, 5 * GIB, 3 * GIB, 2 * GIB)
    assert devices.check_memory(two, 4096) == 2 * GIB + 8 * GIB
    assert devices.check_memory(two, 4096, 2) == 2 * GIB + 16 * GIB


def test_what_the_process_holds_is_what_it_took():
    before, size = devices._resident_memory(), 200 * 2**20
    with mmap.mmap(-1, size) as fresh:  # not what the process has had before
        for page in range(0, size, mmap.PAGESIZE):
            fresh[page] = 1
        held = devices._resident_memory() - before
    assert held == pytest.approx(size, rel=0.1)


def test_too_many_robots_are_refused_with_a_number_that_fits(monkeypatch):
    monkeypatch.setattr(devices, "main_memory", lambda: 8 * GIB)
    monkeypatch.setattr(devices, "_resident_memory", lambda: 2 * GIB)
    # 4096 x (8 - 2) / 8 = 3072 would fit; the power of two below it is 2048
    with pytest.raises(ConfigError, match=r"need 10.0 GiB and the device has 8.0; .* 2048"):
        devices.check_memory(program(3 * GIB, 5 * GIB), 4096)


def test_a_terrain_has_its_own_table_in_the_preset_of_a_device():
    flat, gap = presets.build_config("flat", None, "cpu"), presets.build_config("gap", None, "cpu")
    assert flat.network.variant == "blind" and gap.network.variant == "full"
    assert flat.run.num_envs == gap.run.num_envs == 256
    on_gpu = presets.build_config("flat", None, "gpu")
    assert on_gpu.network.variant == "blind" and on_gpu.run.num_envs == 4096
    assert on_gpu.run.iterations * 4096 * 24 < 50e6  # minutes, not the paper's hours
    assert (
        not flat.randomisation.enabled
        and presets.build_config("gap", None, "gpu").randomisation.enabled
    )


@pytest.mark.parametrize(
    ("experiment", "table", "setting", "value"),
    [
        ("no_cross_attention", "network", "variant", "no_cross_attention"),
        ("no_grf", "network", "variant", "no_grf"),
        ("no_highway", "network", "variant", "no_highway"),
        ("blind", "network", "variant", "blind"),
        ("hpl", "network", "variant", "hpl"),
        ("hpl_teacher", "network", "variant", "hpl_teacher"),
        ("full", "network", "variant", "full"),
        ("paper", "randomisation", "enabled", False),
        ("robust", "randomisation", "ramp", True),
    ],
)
def test_an_experiment_changes_what_its_name_says(experiment, table, setting, value):
    c = presets.build_config("mixed", experiment, "gpu")
    assert getattr(getattr(c, table), setting) == value


@pytest.mark.parametrize("terrain", ["mixed", "flat"])
def test_the_paper_is_the_same_on_every_device(terrain):
    cpu, gpu = (presets.build_config(terrain, "paper", device) for device in ("cpu", "gpu"))
    assert cpu == gpu
    assert cpu.reward.event_time == cpu.physics.control_period  # a touchdown is one step's reward
    additions = cpu.reward.weights.air_time_variance, cpu.reward.weights.foot_up_when_standing
    assert additions == (0.0, 0.0) and cpu.ppo.readout_weight == 0.0 and cpu.ppo.average == 0


def test_the_reward_experiments_differ_in_the_foothold_terms_alone():
    weights = lambda name: presets.build_config("stairs", name, "gpu").reward.weights
    none, quality = weights("no_foothold_reward"), weights("foot_contact_quality")
    assert (none.foothold_placement, none.foot_contact_quality) == (0.0, 0.0)
    assert quality.foothold_placement == 0.0
    # 15 samples of a sole over nothing cost what a perfect foothold gains
    assert 15 * quality.foot_contact_quality == pytest.approx(-2.0, abs=1e-3)
