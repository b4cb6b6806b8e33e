"""The ratios between the stages that were measured, worked by hand."""

import pytest

from cref_jax import bench
from cref_jax.bench import StageTime


def test_the_terrain_query_is_compared_with_the_fastest_engine_of_all():
    seconds = {
        "environment step, warp": 0.010, "environment step, mjx": 0.200, "terrain query": 0.001,
        bench.FOOTHOLD: 0.004, bench.ITERATION: 0.020,
    }  # fmt: skip
    found = bench.ratios([StageTime(stage, 64, s, 0.0) for stage, s in seconds.items()])
    assert found == {
        "terrain query, share of an environment step": pytest.approx(0.1),
        "foothold reward, share of an iteration": pytest.approx(0.2),
    }


def test_engines_are_compared_per_robot():
    seconds = {
        "environment step, mujoco": 0.010, "environment step, mjx": 0.200, "terrain query": 0.001,
        bench.FOOTHOLD: 0.004, bench.ITERATION: 0.020,
    }  # fmt: skip
    robots = dict.fromkeys(seconds, 64) | {"environment step, mjx": 128}
    found = bench.ratios([StageTime(name, robots[name], s, 0.0) for name, s in seconds.items()])
    assert found["engine mujoco over engine mjx, environment steps/s"] == pytest.approx(10.0)
