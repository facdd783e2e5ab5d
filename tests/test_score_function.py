"""Laws of learning by the score function: unbiased, blind to the simulator's derivative, and what credit is."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random
from jax.tree_util import Partial
from learning import ON_SCENE, SCENE, SCORED, begin, learner
from test_learning import plain_rollouts, size

from rtc_mjx import credit
from rtc_mjx import gradients as learning
from rtc_mjx.agent_types import Typed
from rtc_mjx.credit import Credit
from rtc_mjx.losses import LOSSES, Case
from rtc_mjx.methods import METHODS
from rtc_mjx.physics import specialised_step
from rtc_mjx.scenes import DoubleGoal
from rtc_mjx.sharding import ALL_ROWS

ROLLOUTS = 20_000
NO_TYPE = jnp.zeros(0)


BIAS = {  # of the policy's last layer: weights of two components, their means (x, y each), raw scales
    "choice": [1, -1, 0, 0, 0, 0, 0, 0, 0, 0],
    "mean": [0, 0, 1, 0, 1, 0, 0, 0, 0, 0],
}


@functools.cache
def tiny():
    """Three steps of one episode in float64: two components apart, a discriminator that likes to go to the right, and some V."""
    held = learner("gail")
    held = dataclasses.replace(held, scene=DoubleGoal(steps=3))
    state, _ = begin(held)
    policy = with_bias(state.networks.policy, [0.3, -0.3, 1.0, 0.5, -1.0, -0.5, 0, 0, 0, 0])
    critic = Partial(lambda pair: pair[..., 9:10] + 2 * pair[..., 2:3])  # by force and by speed: what was done before counts as well
    expected = Partial(lambda seen: -1.0 + 0.5 * seen[..., 2:3])
    networks = dataclasses.replace(state.networks, policy=policy, discriminator=critic, value=expected)
    return held, networks, held.scene.reset(random.key(4))


def with_bias(policy, bias):
    """The policy with another bias in its last layer."""
    other = jax.tree.map(jnp.asarray, policy)
    other.head.layers[-1].bias = type(other.head.layers[-1].bias)(jnp.asarray(bias, float))
    return other


def along(name, policy):
    """A way of the policy."""
    return with_bias(jax.tree.map(jnp.zeros_like, policy), BIAS[name])


def mean_reward(held, networks, episode, key, way, far):
    """Of one rollout of the policy so far along a way."""
    moved = jax.tree.map(lambda x, w: x + far * w, networks.policy, way)
    agent = held.agent(dataclasses.replace(networks, policy=moved))
    return jnp.mean(credit.reward(agent, held.play(agent, episode, NO_TYPE, key)))


def score_slope(held, networks, episode, key, way):
    """What one rollout says of the mean reward's derivative along a way, by the score function without discount."""
    agent = held.agent(networks)
    track = held.play(agent, episode, NO_TYPE, key)
    case = Case(None, Typed(NO_TYPE, None), track, key, credit.earned(agent, track, NO_TYPE, 1.0, 1.0))

    def loss(policy):
        return LOSSES["policy_gradient"](held.agent(dataclasses.replace(networks, policy=policy)), case, held.weights)

    return -jax.jvp(loss, (networks.policy,), (way,))[1]


def of_rollouts(function, seed):
    """A function of a key, of many: its mean, the standard error of that, and all values."""
    values = np.asarray(jax.jit(jax.vmap(function))(random.split(random.key(seed), ROLLOUTS)))
    return values.mean(), values.std() / ROLLOUTS**0.5, values


@pytest.mark.parametrize("name", BIAS)
def test_score_function_with_its_baseline_is_the_slope_of_the_mean_reward(name, x64):
    """By central differences over the same noise; and, but for the choice, where it is biased, by MGAIL's pathwise gradient."""
    held, networks, episode = tiny()
    way = along(name, networks.policy)
    reward = functools.partial(mean_reward, held, networks, episode)
    ours, error, _ = of_rollouts(lambda key: score_slope(held, networks, episode, key, way), 1)
    apart, their_error, _ = of_rollouts(lambda key: (reward(key, way, 0.1) - reward(key, way, -0.1)) / 0.2, 2)
    assert abs(ours) > 5 * error and abs(ours - apart) < 4 * np.hypot(error, their_error)
    if name != "choice":
        exact, their_error, _ = of_rollouts(lambda key: jax.grad(lambda far: reward(key, way, far))(0.0), 3)
        assert abs(ours - exact) < 4 * np.hypot(error, their_error)


def test_a_baseline_does_not_bias_the_score_function(x64):
    """The same rollouts under V and under none: what V changes is noise around zero, and V does change something."""
    held, networks, episode = tiny()
    way = along("mean", networks.policy)
    without = dataclasses.replace(networks, value=Partial(lambda seen: 0 * seen[..., :1]))
    (_, _, ours), (_, _, theirs) = (of_rollouts(lambda key, n=n: score_slope(held, n, episode, key, way), 3) for n in (networks, without))
    changed = ours - theirs
    assert changed.std() > 0.1 and abs(changed.mean()) < 4 * changed.std() / ROLLOUTS**0.5 and ours.std() < theirs.std()


@pytest.mark.parametrize("method", SCORED)
def test_the_score_function_moves_the_policy_alone_and_the_loss_of_v_only_v(method, x64):
    """Though simulator, discriminator and V are all inside what is differentiated."""
    held = learner(method)
    state, batch = begin(held)

    def lost(networks, name):
        agent = held.agent(networks)
        typed = learning.infer(held, agent, batch, random.key(1))
        played = plain_rollouts(held, agent, batch, typed, random.key(2))
        return learning.branch_losses(held, agent, batch, typed, played, random.key(3), frozenset({name}))[name]

    for name, part in (("policy_gradient", "policy"), ("value", "value")):
        slope = jax.jit(jax.grad(functools.partial(lost, name=name)))(state.networks)
        assert {p for p, x in vars(slope).items() if x is not None and size(x) > 0} == {part}


@pytest.mark.parametrize("method", [name for name in ON_SCENE if METHODS[name].branches[-1].closed_loop])
def test_only_methods_with_pathwise_losses_differentiate_the_simulator(method):
    real, asked = specialised_step(SCENE.world), []

    @jax.custom_vjp
    def step(*inputs):
        return real(*inputs)

    def back(inputs, gradient):
        asked.append(gradient)
        return jax.tree.map(jnp.zeros_like, inputs)

    step.defvjp(lambda *inputs: (real(*inputs), inputs), back)
    held = dataclasses.replace(learner(method), one_step=step)
    state, batch = begin(held)
    jax.eval_shape(lambda n: learning.gradients(held, n, batch, random.key(0), jnp.array(0)), state.networks)
    assert bool(asked) is held.pathwise is (method not in SCORED)


def test_credit_by_hand():
    """Rewards -1, -2, -3 with V = 10, 20, 30: all rewards, one step and V, and half of each."""
    discount, v = 0.5, np.array([10.0, 20.0, 30.0])
    left = np.array([1.75, 1.5, 1.0])  # steps left, discounted
    rates, logits = jnp.append(v / left, 7.0), -jnp.log(jnp.expm1(jnp.array([1.0, 2.0, 3.0])))
    agent = SimpleNamespace(value=lambda seen, g: rates, logit=lambda seen, done: logits)
    track = SimpleNamespace(observations=jnp.zeros((4, 1)), actions=jnp.zeros((3, 1)))
    assert np.allclose(credit.reward(agent, track), [-1, -2, -3], atol=1e-5)
    far = np.array([-1 - 0.5 * 2 - 0.25 * 3, -2 - 0.5 * 3, -3])
    near = np.array([-1 + 0.5 * 20, -2 + 0.5 * 30, -3])  # nothing comes after the last step, whatever V says
    for trace, returns in ((1.0, far), (0.0, near)):
        held = credit.earned(agent, track, NO_TYPE, discount, trace)
        assert np.allclose(held.advantages, returns - v, atol=1e-4) and np.allclose(held.targets, returns / left, atol=1e-4)
    half = credit.earned(agent, track, NO_TYPE, discount, 0.5).advantages
    surprise = near - v
    assert np.allclose(half, [surprise[0] + 0.25 * half[1], surprise[1] + 0.25 * half[2], surprise[2]], atol=1e-4)


def test_advantages_are_standardised_over_the_rollouts_that_are_finite():
    raw, alive = random.normal(random.key(0), (6, 5)) * 3 + 2, jnp.array([True, True, False, True, True, False])
    held = credit.standardised(Credit(raw, raw), alive, ALL_ROWS)
    kept = np.asarray(held.advantages)[np.asarray(alive)]
    assert abs(kept.mean()) < 1e-6 and kept.std() == pytest.approx(1, rel=1e-5) and np.array_equal(held.targets, raw)
    other = credit.standardised(Credit(raw.at[2].set(99.0), raw), alive, ALL_ROWS).advantages
    assert np.array_equal(np.asarray(other)[np.asarray(alive)], kept)
    scaled = credit.standardised(Credit(7 * raw - 3, raw), alive, ALL_ROWS).advantages
    assert np.allclose(scaled, held.advantages, atol=1e-5)  # how sharp the discriminator is does not matter
