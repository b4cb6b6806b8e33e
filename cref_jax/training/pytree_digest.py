"""Leaves of a state by path, and digests that identify a state."""

import hashlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from cref_jax.training import processes


def digest(tree: PyTree) -> str:
    """Compute one SHA-256 over all paths, shapes, dtypes and bits of `tree`, to identify it."""
    total = hashlib.sha256()
    for path, array in sorted(on_host(tree).items()):
        total.update(f"{path} {bits_digest(array)}\n".encode())
    return total.hexdigest()


def by_path(tree: PyTree, name: str = "") -> dict[str, Any]:
    """Map paths, such as params/actor/kernel, to leaves; paths start with `name` if given.

    Raises:
        TypeError: a leaf is not an array.
        ValueError: two leaves have one path.
    """
    flat, _ = jax.tree_util.tree_flatten_with_path(tree)
    leaves = {_path(keys, name): leaf for keys, leaf in flat}
    if len(leaves) < len(flat):
        raise ValueError("two leaves of the state have the same path")
    for path, leaf in leaves.items():
        if not hasattr(leaf, "dtype"):
            raise TypeError(f"{path} is a {type(leaf).__name__}, not an array")
    return leaves


def fill_from(like: PyTree, arrays: dict[str, Any], name: str = "") -> PyTree:
    """Replace the leaves of `like` that `arrays` contains, by paths as in `by_path`."""
    return jax.tree_util.tree_map_with_path(
        lambda keys, leaf: arrays.get(_path(keys, name), leaf), like
    )


def on_host(tree: PyTree) -> dict[str, np.ndarray]:
    """Copy the leaves, by path, to numpy arrays; random keys as their bits."""
    host = processes.to_host({path: _bits(leaf) for path, leaf in by_path(tree).items()})
    return {path: np.asarray(leaf) for path, leaf in host.items()}


def put_like(array: np.ndarray, like: Any, impl: str) -> Any:
    """Convert `array` to the type of leaf that `like` is, on the same devices.

    `impl` names the generator if the leaf is a random key, and is empty otherwise.
    """
    if isinstance(like, np.ndarray | np.generic):
        return array
    leaf = jnp.array(array)  # a copy, because the state's buffers are donated
    place = like.sharding if getattr(like, "committed", False) else None
    if place is not None and not place.is_fully_addressable:  # other processes hold parts of it
        leaf = jax.make_array_from_callback(array.shape, place, lambda part: array[part])
    typed = jax.random.wrap_key_data(leaf, impl=impl) if impl else leaf
    return typed if leaf.sharding == place else jax.device_put(typed, place)


def empty_like(like: Any) -> np.ndarray:
    """Create the array that `on_host` returns for a leaf without elements."""
    bits = jax.eval_shape(_bits, like)
    return np.zeros(bits.shape, bits.dtype)


def describe(tree: PyTree, host: dict[str, np.ndarray]) -> dict[str, dict[str, Any]]:
    """Compute shape, dtype, generator and SHA-256 of every leaf; `host` is `on_host(tree)`."""
    return {
        path: {
            "shape": list(leaf.shape),
            "dtype": str(leaf.dtype),
            "impl": str(jax.random.key_impl(leaf)) if _is_key(leaf) else "",
            "sha256": bits_digest(host[path]),
        }
        for path, leaf in by_path(tree).items()
    }


def bits_digest(array: np.ndarray) -> str:
    """Compute the SHA-256 of dtype, shape and bits."""
    total = hashlib.sha256(f"{array.dtype}{array.shape}".encode())
    total.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return total.hexdigest()


def _path(keys: tuple[Any, ...], name: str) -> str:
    inner = jax.tree_util.keystr(keys, simple=True, separator="/")
    return "/".join(part for part in (name, inner) if part)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _bits(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf
