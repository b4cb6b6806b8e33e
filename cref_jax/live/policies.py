"""Policies to drive the robot with, as the numpy runtime takes them."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cref_jax import deploy, robot
from cref_jax.config import Config, folders
from cref_jax.env.world import World, build_world
from cref_jax.errors import ConfigError
from cref_jax.policy import learner_file, reader, sources
from cref_jax.policy.manifest import build_manifest
from cref_jax.policy.trained import TrainedPolicy
from cref_jax.training import pytree_digest


class Loaded(NamedTuple):
    """A policy that was read from disk."""

    name: str  # by which it is loaded again
    detail: str  # which of a run's policies it is; nothing for an export
    config: Config  # that it was trained with
    manifest: dict[str, Any]
    arrays: dict[str, np.ndarray]

    @property
    def iteration(self) -> int:
        """How long it was trained."""
        return self.manifest["provenance"]["iteration"]

    def runtime(self) -> deploy.Policy:
        """Create the policy in its reset state."""
        return deploy.Policy(self.manifest, dict(self.arrays))


def load(source: Path, world: World | None = None) -> Loaded:
    """Load a bundled policy by name, an export, or the newest checkpoint of a run.

    `world` spares a run the seconds in which one is built from its settings.

    Raises:
        ConfigError: it is none of these.
        CheckpointError: the run has no readable checkpoint.
    """
    path = sources.find_policy(source)
    is_bundled = path.parent == folders.data_folder("policies")
    name = path.name if is_bundled else str(source)
    if path.exists() and (sources.is_run(path) or learner_file.is_learner(path)):
        world = world or build_world(sources.read_config(path), "mujoco")
        loaded = from_training(name, sources.load(path, world))
        try:
            loaded.runtime()
        except deploy.PolicyFormatError as error:  # it has no network of this variant
            raise ConfigError(f"{source}: {error}") from None
        return loaded
    c = sources.read_config(path)
    return Loaded(name, "", c, *reader.read_contents(path))


def from_training(name: str, policy: TrainedPolicy) -> Loaded:
    """Convert a policy in training to what an export of it would hold."""
    arrays = pytree_digest.on_host(policy.train.params.actor["params"])
    arrays = {key: np.asarray(array, np.float32) for key, array in arrays.items()}
    manifest = build_manifest(policy, robot.load(policy.config.robot))
    detail = f"iteration {policy.iteration}"
    return Loaded(name, detail, policy.config, manifest, arrays)


def bundled_names() -> list[str]:
    """List the policies that come with the package."""
    return sorted(folder.name for folder in folders.data_folder("policies").iterdir())
