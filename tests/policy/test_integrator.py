"""The bundled policy `robust` in a program that knows the manifest, the MJCF and the runtime."""

from pathlib import Path

import pytest
from integrator import Harness

from cref_jax.config import folders
from cref_jax.robot.registry import describe

ROBUST = folders.data_folder("policies") / "robust"


def upright(speed: float, seeds: int, policy: Path = ROBUST) -> int:
    return sum(Harness(policy, describe("x2_ultra").xml, k).run(10.0, speed) for k in range(seeds))


@pytest.mark.parametrize("speed", [0.0, 0.4, 0.6, 0.8])
def test_it_stays_upright_for_ten_seconds_with_noise_offsets_and_pushes(speed):
    assert upright(speed, 5) == 5


def test_a_policy_that_never_saw_randomisation_does_not():
    assert upright(0.0, 5, ROBUST.with_name("mixed")) < 4


def test_joints_in_another_order_fall():
    harness = Harness(ROBUST, describe("x2_ultra").xml, 0)
    harness.qpos[:12] = harness.qpos[[6, 7, 8, 9, 10, 11, 0, 1, 2, 3, 4, 5]]  # left for right
    assert not harness.run(10.0, 0.6)
