"""A Python function inside a compiled program, by its name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cref_jax.physics import xla_callback


def scaled(arguments, results):
    x, factor, count, flags = arguments
    if (x < 0.0).any():
        raise ValueError("x must not be negative")
    results[0][...] = x * factor[..., None]
    results[1][...] = count + flags.sum(axis=-1)


xla_callback.register("test_scaled", scaled)


def call(x, factor, count, flags):
    shapes = jax.ShapeDtypeStruct(x.shape, x.dtype), jax.ShapeDtypeStruct((), jnp.int32)
    return xla_callback.call("test_scaled", shapes, x, factor, count, flags)


FLAGS = jnp.array([True, False, True])


def test_it_reads_every_type_and_fills_every_result():
    y, n = jax.jit(call)(jnp.arange(3.0), jnp.float32(2.0), jnp.int32(5), FLAGS)
    np.testing.assert_array_equal(y, [0.0, 2.0, 4.0])
    assert int(n) == 7


def test_under_vmap_it_is_called_once_for_all():
    x = jnp.arange(12.0).reshape(4, 3)
    f = jax.jit(jax.vmap(call, in_axes=(0, 0, None, None)))
    y, n = f(x, jnp.arange(4.0), jnp.int32(1), FLAGS)
    np.testing.assert_array_equal(y, x * np.arange(4.0)[:, None])
    np.testing.assert_array_equal(n, [3, 3, 3, 3])


def test_what_it_raises_fails_the_program():
    error = (jax.errors.JaxRuntimeError, ValueError)  # which one depends on how it was started
    with pytest.raises(error, match="ValueError: x must not be negative"):
        jax.block_until_ready(jax.jit(call)(-jnp.ones(3), jnp.float32(1.0), jnp.int32(0), FLAGS))


def test_a_program_with_it_has_no_address_in_it():
    # so it is the same in every process, and can come from the cache on disk
    text = jax.jit(call).lower(jnp.ones(3), jnp.float32(1.0), jnp.int32(0), FLAGS).as_text()
    assert "test_scaled" in text and "callback" not in text
