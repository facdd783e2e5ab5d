"""The flat product of rows and a matrix is the plain product, under every transformation that learning uses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from rtc_mjx.networks import Pool
from rtc_mjx.products import dot_general

ROWS, MATRIX = random.normal(random.key(0), (4, 6, 5)), random.normal(random.key(1), (4, 5, 3))


def through(product, rows, matrix):
    """A number that depends on a product smoothly."""
    return jnp.sum(jnp.sin(product(jnp.tanh(rows), matrix)))


def penalty(product, rows, matrix):
    """Differentiated once already, as a discriminator's penalty is by its rows."""
    return sum(jnp.sum(slope**2) for slope in jax.grad(through, argnums=(1, 2))(product, rows, matrix))


def plain(rows, matrix):
    """The same by jnp."""
    return rows @ matrix


@pytest.mark.parametrize("axes", [(None, None), (0, None), (None, 0), (0, 0), (1, None), (1, 2)])
@pytest.mark.parametrize("function", [through, penalty])
def test_values_and_gradients_are_those_of_the_plain_product(x64, axes, function):
    rows, matrix = (x.astype(float) if axis is not None else x[0].astype(float) for x, axis in zip((ROWS, MATRIX), axes, strict=True))
    if axes == (1, 2):
        matrix = matrix[0][:, :, None] * jnp.arange(1.0, 7.0)
    found, wanted = [], []
    for product, into in ((dot_general, found), (plain, wanted)):
        each = lambda r, m, product=product: function(product, r, m)  # noqa: E731
        whole = (lambda r, m, each=each: jnp.sum(jax.vmap(each, axes)(r, m))) if axes != (None, None) else each
        into += [whole(rows, matrix), *jax.jit(jax.grad(whole, argnums=(0, 1)))(rows, matrix)]
        into.append(jax.jvp(whole, (rows, matrix), (jnp.cos(rows), jnp.sin(matrix)))[1])
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_one_vector_and_many_axes_of_rows():
    np.testing.assert_allclose(dot_general(ROWS[0, 0], MATRIX[0]), ROWS[0, 0] @ MATRIX[0], rtol=1e-6)
    np.testing.assert_allclose(dot_general(ROWS, MATRIX[0]), ROWS @ MATRIX[0], rtol=1e-6)
    np.testing.assert_allclose(jax.vmap(jax.vmap(lambda x: dot_general(x, MATRIX[0])))(ROWS), ROWS @ MATRIX[0], rtol=1e-6)


def test_gradient_by_the_matrix_sums_over_one_axis_of_rows():
    """The reason why it exists: whatever vmap does to a network, no product of its gradient sums over several axes at once."""
    from flax import nnx

    graph, weights = nnx.split(Pool(3, 2, 4, nnx.Rngs(0)))
    items, beside = jnp.ones((7, 6, 5, 3)), jnp.ones((7, 6, 2))

    def axes_summed(product):
        def loss(weights):
            net = nnx.merge(graph, weights)
            for layer in (net.items.item, net.items.beside, net.items.second, net.score):
                layer.dot_general = product
            return jnp.sum(jax.vmap(jax.vmap(net))(items, beside))

        equations = jax.make_jaxpr(jax.grad(loss))(weights).eqns
        return max(len(e.params["dimension_numbers"][0][0]) for e in equations if e.primitive is lax.dot_general_p)

    assert axes_summed(dot_general) == 1
    assert axes_summed(lax.dot_general) > 1


def test_other_products_are_refused():
    with pytest.raises(ValueError, match="only rows times matrix"):
        dot_general(ROWS, MATRIX[0], (((0,), (0,)), ((), ())))


def test_no_rows_and_a_precision():
    assert dot_general(ROWS[:0], MATRIX[0]).shape == (0, 6, 3)
    exact = dot_general(ROWS, MATRIX[0], precision="highest")
    np.testing.assert_allclose(exact, ROWS @ MATRIX[0], rtol=1e-6)


def test_it_trains_beside_a_batch_of_matrices():
    """Seeds as an axis: each matrix meets its own rows."""
    each = jax.vmap(jax.grad(lambda m, r: through(dot_general, r, m)))(MATRIX, ROWS)
    for k in range(len(MATRIX)):
        np.testing.assert_allclose(each[k], jax.grad(lambda m, k=k: through(plain, ROWS[k], m))(MATRIX[k]), rtol=1e-5, atol=1e-6)
