"""What a training has learned, as one file and back."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_policy import SMALL

from cref_jax import config
from cref_jax.errors import ConfigError
from cref_jax.policy import learner_file, sources, warm_start
from cref_jax.policy.trained import TrainedPolicy
from cref_jax.ppo import normalization
from cref_jax.training import iteration


@pytest.fixture
def small(world):
    return world.replace(config=dataclasses.replace(world.config, network=SMALL))


def learned(world, path) -> TrainedPolicy:
    """Return a policy no two of whose arrays are alike."""
    like = jax.eval_shape(lambda w: iteration.initial_state(w).train, world)
    fill = lambda x, k: jnp.full(x.shape, k + 1, x.dtype)
    leaves, tree = jax.tree.flatten(like)
    train = jax.tree.unflatten(tree, [fill(x, k) for k, x in enumerate(leaves)])
    return TrainedPolicy(world.config, train, 7, path, 1234)


def test_everything_comes_back(small, tmp_path):
    path = tmp_path / "new" / "learned.npz"
    policy = learned(small, path)
    learner_file.write(policy, path)
    back = sources.load(path, small)
    jax.tree.map(np.testing.assert_array_equal, back.train, policy.train)
    assert (back.config, back.iteration, back.samples) == (policy.config, 7, 1234)
    assert sources.read_config(path) == small.config and not sources.is_run(path)


def test_a_readout_comes_back_where_none_is_trained(small, tmp_path):
    read_out = config.override(small.config, {"ppo": {"readout_weight": 0.5}})
    policy = learned(small.replace(config=read_out), tmp_path / "learned.npz")
    assert policy.train.params.readout is not None and not small.config.ppo.readout_weight
    learner_file.write(policy, policy.run)
    back = sources.load(policy.run, small)
    jax.tree.map(np.testing.assert_array_equal, back.train, policy.train)


def test_a_critic_of_another_size_comes_back_as_it_was(small, tmp_path):
    other = {"network": {"critic": [5, 3], "critic_sees": "paper"}, "scan": {"x": [0.0, 1.0, 4]}}
    policy = learned(small.replace(config=config.override(small.config, other)), tmp_path / "a.npz")
    learner_file.write(policy, policy.run)
    back = sources.load(policy.run, small)
    jax.tree.map(np.testing.assert_array_equal, back.train, policy.train)


def test_a_policy_of_billions_of_samples_begins_another_training(small, tmp_path):
    policy = learned(small, tmp_path / "learned.npz")
    policy = policy._replace(samples=2_400_000_000)
    fresh = jax.eval_shape(lambda w: iteration.initial_state(w).train, small)
    fresh = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), fresh)
    began = warm_start.start_from_policy(fresh, policy)
    found = began.statistics.obs
    assert int(found.count) == policy.samples
    std = policy.train.statistics.obs.std
    np.testing.assert_array_equal(found.std, std)
    np.testing.assert_allclose(
        found.summed_variance, policy.samples * (np.square(std) - 1e-4), rtol=1e-6
    )


def test_a_first_update_at_the_mean_leaves_the_deviations_of_a_policy_as_they_were(small, tmp_path):
    policy = learned(small, tmp_path / "learned.npz")._replace(samples=10**9)
    fresh = iteration.initial_state(small).train
    obs = policy.train.statistics.obs
    narrow = obs.replace(std=jnp.full_like(obs.std, 0.02))  # the variance's floor is 0.01^2
    statistics = policy.train.statistics._replace(obs=narrow)
    policy = policy._replace(train=policy.train.replace(statistics=statistics))
    before = warm_start.start_from_policy(fresh, policy).statistics.obs
    seen = jnp.broadcast_to(before.mean, (4, 2, before.mean.size))
    after = normalization.update_statistics(before, seen, jnp.ones((4, 2), bool))
    np.testing.assert_allclose(after.std, before.std, rtol=1e-5)


def test_a_policy_is_summarized_as_it_is_described(small, tmp_path):
    policy = learned(small, tmp_path / "learned.npz")
    learner_file.write(policy, policy.run)
    assert sources.summarize(policy.run) == sources.describe(policy.run, policy)
    bundled = sources.bundled_policy()
    expected = f"{bundled}: x2_ultra, network full, trained on mixed for 86.0 M samples"
    assert sources.summarize(bundled) == expected


def test_another_network_is_refused(small, tmp_path):
    path = tmp_path / "learned.npz"
    learner_file.write(learned(small, path), path)
    wider = config.override(small.config, {"network": {"gru": 9}})
    with pytest.raises(ConfigError, match="does not fit these settings"):
        learner_file.read(path, small.replace(config=wider))


def test_a_file_that_is_something_else_is_refused(small, tmp_path):
    path = tmp_path / "x.npz"
    with pytest.raises(ConfigError, match="cannot read"):
        learner_file.read(path, small)
    path.write_bytes(b"no archive")
    with pytest.raises(ConfigError, match="cannot read"):
        learner_file.read_config(path)
    np.savez(path, kernel=np.zeros(3))
    with pytest.raises(ConfigError, match="not written by export --learner"):
        learner_file.read_config(path)


def test_a_full_disk_leaves_the_file_before(small, tmp_path, monkeypatch):
    path = tmp_path / "learned.npz"
    policy = learned(small, path)
    learner_file.write(policy, path)
    before = path.read_bytes()

    def fill_up(file, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(path), "write_bytes", fill_up)
    with pytest.raises(ConfigError, match=f"cannot write {path}: No space left on device"):
        learner_file.write(policy._replace(iteration=8), path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
