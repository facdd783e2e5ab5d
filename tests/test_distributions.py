"""Distributions: densities integrate to one, divergences match closed forms or sampling, pathwise gradients match differences."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from rtc_mjx import distributions
from rtc_mjx.agent_types import Continuous, Discrete
from rtc_mjx.distributions import UNIFORM_SHARE, Gaussian, GaussianMixture, OneHot

CONTINUOUS = {
    "gaussian": Gaussian(jnp.array([0.3, -0.4]), jnp.array([0.5, 1.2])),
    "mixture": GaussianMixture(
        jnp.array([0.2, -0.5]), jnp.array([[0.5, 0.0], [-1.0, 0.6]]), jnp.array([[0.4, 0.6], [0.7, 0.3]])
    ),
}  # fmt: skip


@pytest.fixture(params=CONTINUOUS)
def continuous(request):
    return CONTINUOUS[request.param]


def test_densities_integrate_to_one(continuous):
    axis = np.linspace(-8, 8, 801)
    grid = jnp.asarray(np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2))
    density = jnp.exp(jax.vmap(continuous.log_prob)(grid))
    assert abs(float(density.sum()) * (axis[1] - axis[0]) ** 2 - 1) < 1e-4


def test_samples_follow_the_density(continuous):
    """The share of samples in a box is the integral of the density over it."""
    noise = jax.vmap(continuous.noise)(random.split(random.key(0), 40_000))
    samples = np.asarray(jax.vmap(continuous.sample)(noise))
    inside = np.mean(np.all((samples > -0.5) & (samples < 0.8), axis=1))
    axis = np.linspace(-0.5, 0.8, 400, endpoint=False) + 1.3 / 800
    grid = jnp.asarray(np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2))
    assert abs(inside - float(jnp.exp(jax.vmap(continuous.log_prob)(grid)).sum()) * (1.3 / 400) ** 2) < 0.01


@pytest.mark.parametrize("size", [2, 5])
def test_one_hot_probabilities_sum_to_one_and_have_a_floor(size):
    held = OneHot(jnp.linspace(-40, 40, size))
    total = sum(float(jnp.exp(held.log_prob(jnp.eye(size)[i]))) for i in range(size))
    assert abs(total - 1) < 1e-6
    assert float(held.probabilities.min()) >= 0.99 * UNIFORM_SHARE / size


def test_one_hot_samples_have_their_probabilities():
    held = OneHot(jnp.array([0.0, 1.0, -1.0]))
    samples = jax.vmap(lambda k: held.sample(held.noise(k)))(random.split(random.key(1), 40_000))
    assert np.all(np.isin(np.asarray(samples), (0, 1))) and np.all(np.asarray(samples).sum(axis=1) == 1)
    assert np.allclose(samples.mean(axis=0), held.probabilities, atol=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_gaussian_kl_matches_sampling(seed):
    keys = random.split(random.key(seed), 4)
    p, q = (Gaussian(random.normal(a, (2,)), jnp.exp(0.3 * random.normal(b, (2,)))) for a, b in (keys[:2], keys[2:]))
    samples = jax.vmap(lambda k: p.sample(p.noise(k)))(random.split(random.key(9), 100_000))
    estimate = jnp.mean(jax.vmap(lambda x: p.log_prob(x) - q.log_prob(x))(samples))
    assert abs(float(estimate - p.kl(q))) < 0.03 * (1 + float(p.kl(q)))
    assert float(p.kl(p)) < 1e-6


def test_one_hot_kl_matches_the_sum():
    p, q = OneHot(jnp.array([0.0, 1.0, -1.0])), OneHot(jnp.array([0.5, 0.0, 0.3]))
    pp, qq = np.asarray(p.probabilities), np.asarray(q.probabilities)
    assert abs(float(p.kl(q)) - float(np.sum(pp * np.log(pp / qq)))) < 1e-6


def test_kl_to_a_mixture_is_unbiased():
    """One-sample estimates average to the integral."""
    p, q = CONTINUOUS["gaussian"], CONTINUOUS["mixture"]
    samples = jax.vmap(lambda k: p.sample(p.noise(k)))(random.split(random.key(2), 100_000))
    estimate = float(jnp.mean(jax.vmap(lambda x: distributions.kl(p, q, x, random.key(0)))(samples)))
    axis = np.linspace(-8, 8, 801)
    grid = jnp.asarray(np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2))
    lp, lq = (jax.vmap(d.log_prob)(grid) for d in (p, q))
    assert abs(estimate - float(jnp.sum(jnp.exp(lp) * (lp - lq))) * (axis[1] - axis[0]) ** 2) < 0.03


def test_kl_of_a_mixture_and_its_gradient_are_unbiased(x64):
    """The average over draws is the integral, and so is that of the gradient, by the weights too."""
    p = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), CONTINUOUS["mixture"])
    q = GaussianMixture(p.logits[::-1], p.mean + 0.3, 1.2 * p.scale)
    keys, axis = random.split(random.key(4), 200_000), np.linspace(-8, 8, 401)
    grid = jnp.asarray(np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2))

    @jax.jit
    def integral(p):
        lp, lq = (jax.vmap(d.log_prob)(grid) for d in (p, q))
        return jnp.sum(jnp.exp(lp) * (lp - lq)) * (axis[1] - axis[0]) ** 2

    value, slope = jax.jit(jax.value_and_grad(lambda p: jnp.mean(jax.vmap(lambda key: distributions.kl(p, q, p.mean[0], key))(keys))))(p)
    exact, exact_slope = jax.value_and_grad(integral)(p)
    assert value == pytest.approx(float(exact), abs=0.01)
    for ours, theirs in zip(jax.tree.leaves(slope), jax.tree.leaves(exact_slope), strict=True):
        assert np.allclose(ours, theirs, atol=0.02)
    assert abs(float(distributions.kl(p, p, p.mean[0], keys[0]))) < 1e-12


@pytest.mark.parametrize("name", CONTINUOUS)
def test_pathwise_gradients_match_differences_of_the_expectation(name, x64):
    """E f under the distribution, integrated on a grid, differentiated by central differences; the component's weight apart."""
    held = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), CONTINUOUS[name])
    axis = np.linspace(-9, 9, 601)
    grid = jnp.asarray(np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2))

    def f(x):
        return jnp.sin(x[0]) + x[0] * x[1] + 0.3 * x[1] ** 2

    values = jax.vmap(f)(grid)

    def expectation(distribution):
        return float(jnp.sum(jnp.exp(jax.vmap(distribution.log_prob)(grid)) * values)) * (axis[1] - axis[0]) ** 2

    noise = jax.vmap(held.noise)(random.split(random.key(3), 400_000))
    gradient = jax.jit(jax.grad(lambda d: jnp.mean(jax.vmap(lambda n: f(d.sample(n)))(noise))))(held)
    for field, index in itertools.product(("mean", "scale"), np.ndindex(held.mean.shape)):
        up, down = (
            type(held)(**{**vars(held), field: getattr(held, field).at[index].add(step)}) for step in (1e-4, -1e-4)
        )  # fmt: skip
        difference = (expectation(up) - expectation(down)) / 2e-4
        assert abs(difference - float(getattr(gradient, field)[index])) < 0.02, (field, index)


def test_straight_through_choice_has_the_sign_of_the_expectations_gradient(x64):
    """Biased, as its docstring says: the gradient by the weights has the right sign where the components lie on one line."""

    def mean_square(logits, noise, choice_gradient=True):
        held = GaussianMixture(logits, jnp.array([[1.0], [-1.0]]), jnp.full((2, 1), 0.1))
        return jnp.mean(jax.vmap(lambda n: (held.sample(n, choice_gradient)[0] - 1) ** 2)(noise))

    logits = jnp.zeros(2)
    noise = jax.vmap(GaussianMixture(logits, jnp.zeros((2, 1)), jnp.ones((2, 1))).noise)(random.split(random.key(4), 10_000))
    assert jax.grad(mean_square)(logits, noise)[0] < 0 < jax.grad(mean_square)(logits, noise)[1]
    assert np.all(jax.grad(lambda x: mean_square(x, noise, False))(logits) == 0)


@pytest.mark.parametrize("space", [Continuous(3, 4), Continuous(3, 4, 2), Discrete(5)])
def test_type_spaces_make_finite_distributions_of_their_size(space):
    for make, count in (
        (space.posterior, space.posterior_outputs),
        (space.inference, space.inference_outputs),
        (space.prior, space.prior_outputs),
    ):
        for scale in (0.0, 30.0):
            held = make(scale * jnp.linspace(-1, 1, count))
            value = held.sample(held.noise(random.key(0)))
            assert value.shape == (space.size,) and np.isfinite(held.log_prob(value))
    fixed = space.fixed_prior()
    assert fixed.sample(fixed.noise(random.key(0))).shape == (space.size,)


def test_default_kl_direction_learns_the_marginal_and_the_literal_one_does_not():
    """Two types used 75/25 with an encoder error of 0.01: 0.745 under E KL[e||p], 0.909 under the paper's literal E KL[p||e]."""
    encoders = [OneHot(jnp.log(jnp.array(p))) for p in ((0.99, 0.01), (0.01, 0.99))]
    weights = (0.75, 0.25)

    def fitted(loss):
        logits = jnp.zeros(2)
        step = jax.jit(
            lambda x: x - 2.0 * jax.grad(lambda y: sum(w * loss(e, OneHot(y)) for w, e in zip(weights, encoders, strict=True)))(x)
        )
        for _ in range(2000):
            logits = step(logits)
        return float(OneHot(logits).probabilities[0])

    assert abs(fitted(lambda e, p: e.kl(p)) - 0.745) < 0.005
    assert abs(fitted(lambda e, p: p.kl(e)) - 0.909) < 0.02
