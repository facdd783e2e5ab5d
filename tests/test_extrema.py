"""The least and the largest of an axis: values as numpy's, derivatives that are somewhere, once, and finite."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtc_mjx.extrema import largest, least

ROWS = np.array([[3.0, 1.0, 2.0], [5.0, 5.0, -np.inf], [np.inf, 0.0, np.inf], [-1.0, -1.0, -1.0]])


@pytest.mark.parametrize(("ours", "theirs", "place"), [(largest, np.max, [0, 0, 0, 0]), (least, np.min, [1, 2, 1, 0])])
def test_value_and_the_one_place_of_the_derivative(ours, theirs, place):
    assert np.array_equal(ours(jnp.array(ROWS), axis=1), theirs(ROWS, axis=1))
    assert np.array_equal(ours(jnp.array(ROWS.T), axis=-2), theirs(ROWS, axis=1))
    slope = jax.grad(lambda x: jnp.sum(ours(x, axis=-1)))(jnp.array(ROWS))
    assert np.array_equal(slope, np.eye(3)[place])


@pytest.mark.parametrize("ours", [largest, least])
def test_what_is_not_a_number_is_not_hidden(ours):
    assert np.isnan(ours(jnp.array([1.0, np.nan, 2.0]), axis=0))
