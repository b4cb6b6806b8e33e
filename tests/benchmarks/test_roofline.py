"""What a function asks of a machine, counted by hand."""

import jax
import jax.numpy as jnp
import pytest

from cref_jax.benchmarks import roofline

X, W = jnp.ones((3, 4)), jnp.ones((4, 5))


def loop(x, w):
    return jax.lax.scan(lambda c, _: (c + jnp.sum(x @ w), None), 0.0, None, length=7)[0]


def choice(x, w):
    return jax.lax.cond(x[0, 0] > 0, lambda: jnp.sum(x @ w), lambda: jnp.sum(x))


@pytest.mark.parametrize(
    ("function", "flops"),
    [
        (lambda x, w: x @ w, 2 * 3 * 4 * 5),
        (jax.jit(lambda x, w: x @ w), 2 * 3 * 4 * 5),
        (lambda x, w: x + 1.0, 0),
        (loop, 7 * 2 * 3 * 4 * 5),
        (choice, 2 * 3 * 4 * 5),
        # forward, and x' g for W; the gradient of x is not asked for
        (jax.grad(lambda w: jnp.sum((X @ w) ** 2)), 2 * 2 * 3 * 4 * 5),
        (jax.vmap(lambda x, w: x @ w, in_axes=(0, None)), 2 * 3 * 4 * 5),
    ],
    ids=["product", "jit", "none", "loop", "choice", "gradient", "vmap"],
)
def test_products_are_counted_as_often_as_they_are_made(function, flops):
    arguments = (W,) if flops == 2 * 2 * 3 * 4 * 5 else (X, W)
    assert roofline.count_work(function, *arguments).flops == flops


def test_a_product_and_a_copy_each_have_their_own_limit():
    # 120 operations and 4 bytes each of 12 + 20 + 15 numbers
    work = roofline.count_work(lambda x, w: x @ w, X, W)
    assert work == (120, 188)
    assert work.seconds(roofline.Rates(products=60.0, memory=188.0)) == 2.0
    assert work.seconds(roofline.Rates(products=240.0, memory=18.8)) == pytest.approx(10.0)
