"""The estimate for a GPU: what belongs to which stage, and how long it takes at least."""

import importlib.util

import pytest

from cref_jax import gpu_program
from cref_jax.benchmarks import hlo, source_stages
from cref_jax.config import Config
from cref_jax.errors import ConfigError

H100 = gpu_program.CARDS["h100"]


def frames(*places):
    return tuple(hlo.Frame(f"/there/{file}", function) for file, function in places)


STEP = ("cref_jax/physics/simulation.py", "Physics.step.<locals>.substep")
SUBSTEP = ("cref_jax/physics/mjx_engine.py", "MjxEngine.substep")
NEWTON = ("mujoco/mjx/_src/solver.py", "solve.<locals>.body")
SEARCH = ("mujoco/mjx/_src/solver.py", "_linesearch")
FEED = ("cref_jax/training/camera_feed.py", "update_feed.<locals>.<lambda>")


@pytest.mark.parametrize(
    ("stack", "stage"),
    [
        ((SEARCH, NEWTON, SUBSTEP, STEP), "physics: MJX, line search"),
        ((NEWTON, SUBSTEP, STEP), "physics: MJX, Newton"),
        ((SUBSTEP, STEP), "physics: MJX, before the solver"),
        ((("cref_jax/physics/simulation.py", "Physics.planes"), STEP), "physics: tangent planes"),
        ((("cref_jax/ppo/learner.py", "update.<locals>.on_epoch"),), "update"),
        ((("cref_jax/training/iteration.py", "chunk"),), "rest"),
    ],
)
def test_a_kernel_belongs_to_the_stage_of_its_functions(stack, stage):
    assert source_stages.stage_of(frames(*stack)) == stage


class Counted(hlo.Program):
    """A program of three kernels: many launches, many bytes, a copy that a loop carries."""

    def __init__(self):
        super().__init__("")

    def kernels(self, trip_count):
        newton, feed = frames(NEWTON, SUBSTEP, STEP), frames(FEED)
        yield hlo.Kernel(newton, (), "fusion", 1000 * trip_count(newton), 8, 0)
        yield hlo.Kernel(
            frames(("cref_jax/ppo/learner.py", "update")), (), "fusion", 1, 2_680_000_000, 0
        )
        yield hlo.Kernel((), newton, "copy", 24 * trip_count(feed), 8, 0)


def test_a_kernel_takes_the_longest_of_launch_bytes_and_products():
    found = gpu_program.estimate_stages(Counted(), Config(), H100)
    assert list(found) == ["physics: MJX, Newton", "update"]  # the longest first
    # 1000 launches in each of six iterations, and a copy for each frame that comes at 20 Hz in 24
    # steps of 20 ms: ten; 3 us each
    assert found["physics: MJX, Newton"].launches == pytest.approx(6010)
    assert found["physics: MJX, Newton"].seconds == pytest.approx(6010 * 3e-6)
    # 2.68 GB at 80 % of 3.35 TB/s
    assert found["update"].seconds == pytest.approx(1e-3)


def test_without_the_plugin_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"needs .*: pip install 'cref-jax\[cuda12\]'$"):
        gpu_program.prepare()
