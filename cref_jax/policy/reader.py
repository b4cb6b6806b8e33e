"""Read an exported policy back, for evaluation in JAX."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cref_jax import deploy
from cref_jax.config import Config, presets
from cref_jax.env.world import World, build_world
from cref_jax.errors import ConfigError
from cref_jax.policy.trained import TrainedPolicy
from cref_jax.training import iteration, pytree_digest


def read(path: Path, world: World | None = None) -> TrainedPolicy:
    """Load an exported policy for evaluation in JAX; the critic is not exported, so it is zero.

    Raises:
        ConfigError: it is not a policy that this program can read.
    """
    content, arrays = read_contents(path)
    c = trained_config(content)
    like = jax.eval_shape(lambda w: iteration.initial_state(w).train, world or build_world(c))
    train = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    actor = pytree_digest.fill_from(
        train.params.actor, {f"params/{k}": jnp.array(x) for k, x in arrays.items()}
    )
    terms = content["observation"]
    obs = train.statistics.obs.replace(mean=jnp.array(terms["mean"]), std=jnp.array(terms["std"]))
    train = train.replace(
        params=train.params._replace(actor=actor),
        statistics=train.statistics._replace(obs=obs),
    )
    provenance = content["provenance"]
    return TrainedPolicy(c, train, provenance["iteration"], path, provenance["samples"])


def policy_digest(policy: TrainedPolicy) -> str:
    """Compute the SHA-256 of all that determines a policy's actions, equal for run and export."""
    c = policy.config
    settings = [dataclasses.asdict(part) for part in (c.network, c.robot, c.camera)]
    del settings[1]["name"]  # its joints decide, and digests from before robots had names hold
    digest = hashlib.sha256(json.dumps(settings).encode())
    arrays = pytree_digest.on_host(policy.train.params.actor["params"])
    statistics = policy.train.statistics.obs
    for name, array in sorted({**arrays, "mean": statistics.mean, "std": statistics.std}.items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(array, np.float32).tobytes())
    return digest.hexdigest()


def read_contents(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read an exported policy's manifest and weights, and check every number."""
    try:
        content, arrays = deploy.contents(path)
        deploy.Policy(content, arrays)
    except deploy.PolicyFormatError as error:
        raise ConfigError(str(error)) from None
    return content, arrays


def trained_config(content: dict[str, Any]) -> Config:
    """Read the settings that an exported policy was trained with from its manifest."""
    return presets.apply_table(Config(), content["provenance"]["config"], Path("manifest.json"))
