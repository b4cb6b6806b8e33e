"""What users rely on is there under its name: terrain, depth, settings, the runtime, commands."""

import dataclasses
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from cref_jax import config, deploy, depth, terrain
from cref_jax.config import Camera, Config
from cref_jax.errors import ConfigError
from cref_jax.policy import sources

COMMANDS = (
    "train", "eval", "play", "export", "sim2sim", "report", "bench", "params", "gpu_program",
    "doctor", "reproduce",
)  # fmt: skip
SETTINGS = {
    "run": "Run", "robot": "Robot", "physics": "Physics", "terrain": "Terrain",
    "curriculum": "Curriculum", "command": "Command", "episode": "Episode",
    "randomisation": "Randomisation", "reward": "Reward", "scan": "Scan", "camera": "Camera",
    "foothold": "Foothold", "network": "Network", "ppo": "PPO",
    "distillation": "Distillation",
}  # fmt: skip
POLICIES = ("combined", "mixed", "robust")


@pytest.fixture(scope="module")
def step() -> terrain.Terrain:
    """Return 2 m x 2 m of columns of 0.5 m: the ground is 0.4 m high where x is 1 m or more."""
    return terrain.from_heights(np.repeat([[0.0], [0.0], [0.4], [0.4]], 4, axis=1), cell=0.5)


def bundled(name: str):
    return sources.bundled_policy(name)


def test_the_ground_has_the_height_of_the_column_under_a_point(step):
    points = np.array([[0.2, 0.2], [0.99, 1.5], [1.01, 1.5], [9.0, 1.0]])  # the last one: outside
    np.testing.assert_allclose(terrain.height_at(step, points), [0.0, 0.0, 0.4, 0.4])


@pytest.mark.parametrize(
    ("point", "closest", "normal", "distance"),
    [
        ((0.3, 0.8, 0.1), (0.3, 0.8, 0.0), (0.0, 0.0, 1.0), 0.1),  # over the ground
        ((0.95, 0.8, 0.2), (1.0, 0.8, 0.2), (-1.0, 0.0, 0.0), 0.05),  # before the riser
        ((1.2, 0.8, 0.37), (1.2, 0.8, 0.4), (0.0, 0.0, 1.0), -0.03),  # in the ground
    ],
)
def test_the_closest_point_of_the_ground_has_a_normal_and_a_distance(
    step, point, closest, normal, distance
):
    found = terrain.closest_point(step, jnp.array(point))
    for value, expected in zip(found, (closest, normal, distance), strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-5)


def test_a_camera_that_looks_down_sees_how_far_the_ground_is(step):
    camera = Camera(shape=(4, 6), view=(40.0, 40.0), d_max=3.0)
    # 1 m above the lower ground, over the riser; right is -y, down the image is -x
    right_down_forward = jnp.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    place, no_links = jnp.array([1.0, 1.0, 1.0]), jnp.zeros((0, 7))
    image = depth.render(step, place, right_down_forward.T, no_links, camera)
    np.testing.assert_allclose(image[:2], np.full((2, 6), 0.6), atol=1e-5)
    np.testing.assert_allclose(image[2:], np.full((2, 6), 1.0), atol=1e-5)


def test_the_settings_are_frozen_dataclasses_of_these_names():
    found = {f.name: type(getattr(Config(), f.name)) for f in dataclasses.fields(Config)}
    assert found == {name: getattr(config, kind) for name, kind in SETTINGS.items()}
    assert type(Config().reward.weights) is config.RewardWeights
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config().ppo.epochs = 7  # type: ignore[misc]


def test_settings_are_overridden_by_a_table_and_mistakes_are_named():
    changed = config.override(
        Config(), {"ppo": {"epochs": 7}, "reward": {"weights": {"stumble": -1}}}
    )
    assert (changed.ppo.epochs, changed.reward.weights.stumble) == (7, -1.0)
    assert (changed.ppo.clip, changed.network) == (Config().ppo.clip, Config().network)
    with pytest.raises(ConfigError, match=r"unknown setting 'ppo.epoch'; did you mean 'epochs'\?"):
        config.override(Config(), {"ppo": {"epoch": 7}})


@pytest.mark.parametrize("name", POLICIES)
def test_a_bundled_policy_passes_its_self_test(name: str):
    assert set(deploy.self_test(bundled(name), rounds=1)) == {"a frame and a step", "a step"}


@pytest.mark.parametrize("name", POLICIES)
def test_a_bundled_policy_steps_and_forgets_when_it_is_reset(name: str):
    policy = deploy.load(bundled(name))
    q, still = policy.joints.default, np.zeros(3)

    def walk() -> list[np.ndarray]:
        policy.reset()
        targets = []
        for now in 0.02 * np.arange(12):
            assert policy.on_depth(np.full(policy.image_shape, 1.0, np.float32), now) == 0
            gravity, ahead = np.array([0.0, 0.0, -1.0]), np.array([0.5, 0.0, 0.0])
            targets.append(policy.step(still, gravity, ahead, q, np.zeros_like(q), now))
            assert policy.status == deploy.Status.OK
        return targets

    first, again = walk(), walk()
    assert first[0].shape == (12,) and np.abs(np.array(first) - q).max() < 1.5  # rad
    np.testing.assert_array_equal(first[0], q)  # held for 0.2 s, while the inputs are checked
    assert not np.array_equal(first[-1], first[-2])  # it remembers the steps before
    np.testing.assert_array_equal(first, again)


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_says_how_it_is_used(command: str):
    asked = [sys.executable, "-m", f"cref_jax.{command}", "--help"]
    done = subprocess.run(asked, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"usage: python -m cref_jax.{command}" in done.stdout
