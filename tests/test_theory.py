"""The simplified model: closed forms worked out by hand, laws of information, the theorem on random instances, what is learned."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtc_mjx.errors import UsageError
from rtc_mjx.methods import METHODS
from rtc_mjx.theory import __main__ as command
from rtc_mjx.theory import learning, solutions, tables, theorem
from rtc_mjx.theory.learning import Setting
from rtc_mjx.theory.tables import BIT, Expert

EPSILONS = (0.0, 0.02, 0.1)


def h(p):
    """Entropy in bits of an event of probability p."""
    return float(-p * np.log2(p) - (1 - p) * np.log2(1 - p)) if 0 < p < 1 else 0.0


def bits(value):
    return float(value) / BIT


def shares(seed, *shape):
    """A random joint distribution."""
    return jnp.array(np.random.default_rng(seed).dirichlet(np.ones(np.prod(shape))).reshape(shape))


def channel(seed, *shape):
    """Random distributions along the last axis."""
    return jnp.array(np.random.default_rng(seed).dirichlet(np.ones(shape[-1]), shape[:-1]))


def test_entropies_by_hand(x64):
    assert bits(tables.entropy(jnp.full(4, 0.25))) == pytest.approx(2)
    assert bits(tables.entropy(jnp.array([0.5, 0.25, 0.25, 0.0]))) == pytest.approx(1.5)
    assert bits(tables.conditional_entropy(jnp.array([[0.5, 0.0], [0.25, 0.25]]))) == pytest.approx(0.5)


def test_divergences_by_hand(x64):
    p, q = jnp.array([0.5, 0.5, 0.0]), jnp.array([0.25, 0.25, 0.5])
    assert bits(tables.kl(p, q)) == pytest.approx(1)
    assert float(tables.total_variation(p, q)) == pytest.approx(0.5)


def test_information_of_a_symmetric_channel_by_hand(x64):
    assert bits(tables.mutual_information(jnp.array([[0.4, 0.1], [0.1, 0.4]]))) == pytest.approx(1 - h(0.2))


@pytest.mark.parametrize("seed", range(5))
def test_processing_never_adds_information(seed, x64):
    joint = shares(seed, 3, 4)
    assert float(tables.mutual_information(joint @ channel(seed, 4, 5))) <= float(tables.mutual_information(joint)) + 1e-12


@pytest.mark.parametrize("seed", range(5))
def test_type_shift_is_conditional_plus_marginal_shift(seed, x64):
    joint, prior = shares(seed, 3, 4), shares(200 + seed, 4)
    whole = tables.type_shift(joint, prior)
    assert float(whole) == pytest.approx(float(tables.conditional_shift(joint) + tables.marginal_shift(joint, prior)))
    assert float(tables.conditional_shift(tables.independent(joint))) == pytest.approx(0, abs=1e-12)


def test_policies_are_uniform_where_nothing_was_demonstrated():
    assert np.array_equal(tables.conditional(jnp.array([[0.0, 0.0], [0.1, 0.3]])), np.array([[0.5, 0.5], [0.25, 0.75]], np.float32))


def test_a_table_without_doubt_has_finite_gradients(x64):
    for measure in (tables.entropy, tables.mutual_information, lambda x: tables.kl(x, x)):
        assert np.all(np.isfinite(jax.grad(measure)(jnp.eye(2) / 2)))


@pytest.mark.parametrize("epsilon", EPSILONS)
@pytest.mark.parametrize(("green", "left"), [(0.5, 0.5), (0.3, 0.8)])
def test_solution_1_by_hand(green, left, epsilon, x64):
    """L_rec is the doubt about the light, H(S|O); the type knows nothing of it and all of the turn; both prior and paired err alike."""
    expert = solutions.crossing(green, left)
    found = solutions.measures(expert, solutions.solution_1(expert, epsilon))
    looks_green = green * (1 - epsilon) + (1 - green) * epsilon
    doubt = h(green) + h(epsilon) - h(looks_green)
    assert bits(found.reconstruction) == pytest.approx(doubt, abs=1e-9)
    assert float(found.conditional_shift) == pytest.approx(0, abs=1e-9) and float(found.luck) == pytest.approx(0, abs=1e-9)
    assert float(found.type_information) == pytest.approx(green * h(left)) and float(found.mind) == pytest.approx(1)
    assert float(found.error_prior) == pytest.approx(float(found.error_paired), abs=1e-9)
    assert float(found.information) == pytest.approx(h(green))


@pytest.mark.parametrize("epsilon", EPSILONS)
@pytest.mark.parametrize(("green", "left"), [(0.5, 0.5), (0.3, 0.8)])
def test_solution_2_by_hand(green, left, epsilon, x64):
    """Perfect under paired types, and blind under the prior: it runs red lights and waits at green ones."""
    expert = solutions.crossing(green, left)
    found = solutions.measures(expert, solutions.solution_2(expert, epsilon))
    assert float(found.reconstruction) == pytest.approx(0, abs=1e-12) and float(found.error_paired) == pytest.approx(0, abs=1e-12)
    assert float(found.type_information) == pytest.approx(h(green) + green * h(left))
    assert float(found.residual) == pytest.approx(0, abs=1e-9) and float(found.luck) == pytest.approx(1)
    assert float(found.information_prior) == pytest.approx(0, abs=1e-9)
    assert float(found.error_prior) == pytest.approx(2 * green * (1 - green))
    assert float(found.marginal_shift) == pytest.approx(0, abs=1e-9)


def test_solution_2s_policy_is_the_best_one_for_its_encoder(x64):
    expert = solutions.crossing(0.4, 0.7)
    second = solutions.solution_2(expert, 0.1)
    best = solutions.completed(expert, second.encoder, 0.1)
    assert np.allclose(best.policy, second.policy) and np.allclose(best.prior, second.prior)


@pytest.mark.parametrize("seed", range(5))
def test_completed_agents_have_the_least_losses_for_their_encoder(seed, x64):
    expert = Expert(shares(seed, 2), channel(seed, 2, 3))
    best = solutions.completed(expert, channel(100 + seed, 2, 3, 3), 0.1)
    other = replace(best, policy=channel(200 + seed, 2, 3, 3), prior=shares(seed, 3))
    assert float(solutions.reconstruction(expert, best)) < float(solutions.reconstruction(expert, other))
    assert float(solutions.type_kl(expert, best)) < float(solutions.type_kl(expert, other))


@pytest.mark.parametrize("epsilon", EPSILONS)
def test_boundary_on_the_fair_crossing_is_the_entropy_of_epsilon_in_bits(epsilon, x64):
    assert float(solutions.boundary(solutions.crossing(), epsilon)) == pytest.approx(h(epsilon), abs=1e-9)


def test_counterexample_keeps_the_claim_and_breaks_its_last_step():
    c = theorem.example(theorem.counterexample)
    assert c.shifted and c.claim and c.bounded and not c.as_varied and not c.last_step
    found = [bits(x) for x in (c.information, c.information_hat, c.entropy, c.entropy_hat, c.noise, c.noise_hat)]
    assert found == pytest.approx([0.3134, 0.1218, 0.6491, 0.3308, 0.3357, 0.2090], abs=5e-5)


def test_claim_of_theorem_1_breaks_for_a_deterministic_policy_by_hand():
    """I(S,A) = H(A) - H(A|S) = 1 - 0.9 h(5/9); under the prior only type 0, drawn half the time, tells the state: h(0.1) / 2."""
    c = theorem.example(theorem.breaking)
    assert bits(c.information) == pytest.approx(1 - 0.9 * h(5 / 9)) and bits(c.information_hat) == pytest.approx(h(0.1) / 2)
    assert c.shifted and c.reversed and not c.bounded
    assert c.determined and bits(c.residual) == pytest.approx(0)  # in training, type 0 is action 0 and type 1 action 2
    assert bits(c.residual_hat) == pytest.approx(0.5 * h(0.1))  # at test type 0 meets state 1, with probability 0.1


def test_what_a_type_leaves_open_in_training_by_hand(x64):
    """Two types as likely; the first does 0 or 1 by a fair state, the second always 2: half a bit. At test the same."""
    policy = jnp.array([[[1.0, 0, 0], [0, 0, 1]], [[0, 1.0, 0], [0, 0, 1]]])
    c = theorem.compare(theorem.Instance(jnp.full((2, 2), 0.25), policy))
    assert bits(c.residual) == pytest.approx(0.5) and bits(c.residual_hat) == pytest.approx(0.5) and not c.determined


def test_a_type_that_says_the_action_in_training_does_not_make_theorem_1_true():
    """It does where every pair of state and type came up: then the type says the action at test too."""
    counts = theorem.census(theorem.compared("H(A|G) = 0 in training", 4000))
    assert counts["determined"] == counts["instances"] > 3000
    assert 0.02 * counts["instances"] < counts["determined_without_claim"] < 0.5 * counts["instances"]
    drawn = theorem.HYPOTHESES["H(A|G) = 0 in training"](np.random.default_rng(0), 4000)
    c = theorem.compared("H(A|G) = 0 in training", 4000)
    met = np.all(drawn.state_type > 0, axis=(1, 2))
    assert np.sum(met) > 200 and np.all(c.residual_hat[met] < theorem.MARGIN) and np.all(c.claim[met & c.shifted])


@pytest.mark.parametrize("hypothesis", theorem.HYPOTHESES)
def test_theorem_1_holds_where_the_type_leaves_less_open_than_actions_tell(hypothesis):
    counts = theorem.census(theorem.compared(hypothesis, 4000, seed=1))
    assert counts["instances"] > 3000  # where pairs of state and type are missing, some have no shift
    assert counts["bounded_without_claim"] == 0
    assert counts["bounded"] > 900 or hypothesis == "any policy"  # policies this noisy leave too much open


@pytest.mark.parametrize("hypothesis", theorem.HYPOTHESES)
def test_last_step_of_theorem_1_never_fails_with_its_condition(hypothesis):
    counts = theorem.census(theorem.compared(hypothesis, 4000, seed=2))
    assert counts["as_varied"] > 900 and counts["as_varied_and_last_step_fails"] == 0


def test_theorem_1_fails_often_without_its_conditions():
    counts = theorem.census(theorem.compared("deterministic", 4000, seed=3))
    assert counts["reversed"] > 0.3 * counts["instances"] and counts["last_step_fails"] > 0.03 * counts["claim"]


def test_solution_2_meets_every_condition_of_theorem_1():
    counts = theorem.census(theorem.compared("state-blind (solution 2)", 4000))
    assert counts["claim"] == counts["bounded"] == counts["as_varied"] == counts["instances"] and counts["last_step_fails"] == 0


def test_bound_is_exact_where_the_type_can_be_read_off_the_action():
    c = theorem.compared("deterministic, type in action", 1000)
    assert np.allclose(c.information_hat, c.residual_hat)
    assert np.all(c.last_step[c.shifted])


def test_what_a_nearly_blind_policy_leaves_open_is_bounded_by_epsilon():
    c = theorem.compared("nearly state-blind", 1000)
    most = float(theorem.fano(theorem.NEARLY, theorem.ACTIONS))
    assert np.all(c.residual_hat <= most) and np.max(c.residual_hat) > 0.5 * most


def setup(epsilon=0.1, type_kl=0.2, adversarial=1.0):
    expert = Expert(shares(1, 2), channel(2, 2, 3))
    return learning.start(3, expert), expert, Setting(epsilon, type_kl, adversarial)


def gradient(method, setting, logits, expert):
    return jax.jit(jax.grad(lambda x: learning.objective(x, expert, METHODS[method], setting)))(logits)


def difference(method, logits, expert, setting):
    """What L_adv alone adds to the gradient."""
    both = (gradient(method, replace(setting, adversarial=weight), logits, expert) for weight in (1.0, 0.0))
    return jax.tree.map(jnp.subtract, *both)


def central(function, logits, field, size=1e-6):
    """Central differences by every number of a field."""
    base, slopes = np.array(getattr(logits, field)), np.zeros(getattr(logits, field).shape)
    for index in np.ndindex(base.shape):
        ends = []
        for sign in (1, -1):
            moved = base.copy()
            moved[index] += sign * size
            ends.append(float(function(replace(logits, **{field: jnp.array(moved)}))))
        slopes[index] = (ends[0] - ends[1]) / (2 * size)
    return slopes


@pytest.mark.parametrize("field", ["encoder", "policy", "prior"])
def test_gradient_of_the_naive_objective_matches_differences(field, x64):
    logits, expert, setting = setup(adversarial=0.0)
    function = jax.jit(lambda x: learning.objective(x, expert, METHODS["naive_hierarchy_d"], setting))
    exact = getattr(gradient("naive_hierarchy_d", setting, logits, expert), field)
    assert np.allclose(exact, central(function, logits, field), atol=1e-8) and np.max(np.abs(exact)) > 1e-3


@pytest.mark.parametrize("field", ["encoder", "policy"])
def test_with_the_best_discriminator_fixed_adversarial_gradient_is_that_of_kl_less_two_jsd(field, x64):
    logits, expert, setting = setup()

    @jax.jit
    def divergence(x):
        agent = x.agent(setting.epsilon)
        q, p = agent.played(agent.seen_types(expert)), expert.joint
        return tables.kl(q, p) - tables.kl(p, (p + q) / 2) - tables.kl(q, (p + q) / 2)

    exact = getattr(difference("naive_hierarchy_d", logits, expert, setting), field)
    assert np.allclose(exact, central(divergence, logits, field), atol=1e-8) and np.max(np.abs(exact)) > 1e-3


@pytest.mark.parametrize("method", ["naive_hierarchy_d", "rtc_d"])
def test_prior_gets_no_gradient_from_the_exact_adversarial_loss(method, x64):
    logits, expert, setting = setup()
    held = difference(method, logits, expert, setting)
    assert np.all(held.prior == 0) and np.any(held.policy != 0) and np.any(held.encoder != 0)


def test_rtc_without_adversarial_loss_is_naive(x64):
    logits, expert, setting = setup(adversarial=0.0)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(*(jax.tree.leaves(gradient(m, setting, logits, expert)) for m in ("rtc_d", "naive_hierarchy_d")), strict=True)
    )


@pytest.mark.parametrize("method", ["naive_hierarchy_d", "rtc_d"])
def test_fakes_of_all_branches_make_one_distribution(method):
    assert sum(learning.share(branch) for branch in METHODS[method].branches) == 1


def test_best_discriminator_cannot_tell_the_expert_from_itself(x64):
    expert = solutions.crossing()
    assert np.all(learning.logit(expert, expert.joint) == 0)
    assert float(jnp.max(jnp.abs(learning.logit(expert, expert.joint[::-1])))) == learning.LARGEST_LOGIT


@pytest.fixture(scope="module")
def learned():
    """epsilon 0.05, so that beta* = 0.286; one beta on either side."""
    expert, settings = solutions.crossing(), learning.grid((0.05,), (0.2, 0.5), (0.0, 0.3))
    return {method: learning.sweep(expert, method, settings, 8, 2000) for method in ("naive_hierarchy_d", "rtc_d")}


def test_below_the_boundary_naive_types_hold_luck_and_fail_under_the_prior(learned):
    found = learned["naive_hierarchy_d"].along_type_kl(0.05, 0.0).measures
    assert np.mean(found.luck[0]) > 0.5 and np.mean(found.luck[0] > 0.25) > 0.7
    assert np.mean(found.error_prior[0]) > 4 * np.mean(found.error_paired[0]) and np.min(found.mind[0]) > 0.9


def test_above_the_boundary_naive_types_hold_no_luck(learned):
    found = learned["naive_hierarchy_d"].along_type_kl(0.05, 0.0).measures
    assert np.max(found.luck[1]) < 0.05 and np.max(found.error_prior[1]) < 0.11


def test_rtc_finds_solution_1_where_naive_does_not(learned):
    found = learned["rtc_d"].along_type_kl(0.05, 0.3).measures
    assert np.max(found.luck) < 0.05 and np.min(found.mind) > 0.9
    assert np.max(found.error_prior) < 0.1


def test_lambda_alone_moves_the_change_of_sides_to_a_larger_beta():
    """An adversarial loss under paired types only: luck stays in types beyond beta*, and goes at a beta further up."""
    settings = learning.grid((0.05,), (0.3, 1.0), (0.0, 1.0))
    held = learning.sweep(solutions.crossing(), "naive_hierarchy_d", settings, 8, 2000)
    without, with_it = (held.along_type_kl(0.05, weight).measures for weight in (0.0, 1.0))
    assert np.mean(without.luck[0]) < 0.1 < 0.5 < np.mean(with_it.luck[0])
    assert np.mean(with_it.error_prior[0]) > 2 * np.mean(without.error_prior[0])
    assert np.max(without.luck[1]) < 0.05 and np.max(with_it.luck[1]) < 0.05


def test_rtc_finds_solution_1_by_a_strong_adversarial_loss_where_only_the_priors_rollouts_are_fakes():
    """With both branches as fakes types keep luck, and agents err under the prior twice as often as they must (epsilon)."""
    settings = learning.grid((0.05,), (0.1,), (3.0,))
    both, prior_alone = (learning.sweep(solutions.crossing(), "rtc_d", settings, 8, 2000, fakes).measures for fakes in ("all", "test"))
    assert np.mean(both.luck) > 0.3 and np.mean(both.error_prior) > 0.08
    assert np.max(prior_alone.luck) < 0.05 and np.max(prior_alone.error_prior) < 0.06 and np.min(prior_alone.mind) > 0.95


def test_naive_hierarchy_knows_no_difference_between_fakes():
    settings = learning.grid((0.05,), (0.1,), (1.0,))
    both, prior_alone = (learning.sweep(solutions.crossing(), "naive_hierarchy_d", settings, 2, 50, fakes) for fakes in ("all", "test"))
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(both), jax.tree.leaves(prior_alone), strict=True))


def test_ends_are_counted_by_hand():
    found = learning.ends(np.array([0.0, 0.05, 0.31, 0.95]))
    assert found == {"solution 1": 0.5, "solution 2": 0.25, "in between": 0.25}


def test_a_learned_prior_is_the_encoders_marginal(learned):
    for results in learned.values():
        assert np.max(results.measures.marginal_shift) < 1e-3


def test_the_grid_holds_every_combination_and_parts_come_out_in_order(learned):
    part = learned["rtc_d"].along_type_kl(0.05, 0.3)
    assert np.allclose(part.settings.type_kl, [0.2, 0.5]) and np.allclose(part.settings.adversarial, 0.3)
    assert part.measures.luck.shape == (2, 8)
    with pytest.raises(UsageError, match=r"lambda 7 was not swept"):
        learned["rtc_d"].along_type_kl(0.05, 7)


def test_the_command_prints_tables_and_writes_figure_and_json(tmp_path, capsys, monkeypatch):
    for name, values in {"EPSILONS": (0.05,), "TYPE_KLS": (0.1, 0.3), "ADVERSARIALS": (0.0, 0.1, 1.0)}.items():
        monkeypatch.setattr(learning, name, values)
    file, figure = tmp_path / "theory.json", tmp_path / "theory.png"
    command.main(["--instances", "50", "--seeds", "2", "--updates", "5", "--json", str(file), "--figure", str(figure)])
    assert "β*" in capsys.readouterr().out and figure.read_bytes().startswith(b"\x89PNG")
    held = json.loads(file.read_text())
    assert len(held["solutions"]) == 2
    second = held["solutions"][1]["tables"]
    assert np.shape(second["encoder"]) == (2, 3, 3) == np.shape(second["policy"])
    assert np.allclose(second["training_actions"], second["expert_actions"])  # solution 2 is perfect under paired types ...
    assert np.allclose(second["test_actions"], np.full((2, 1), 0.5) * [[0.5, 0.25, 0.25]])  # ... and blind at test
    broken = held["theorem"]["examples"]["breaks the claim"]
    assert broken["residual"] == pytest.approx(0) and np.allclose(np.sum(broken["tables"]["test_actions"], axis=0), [0.45, 0.05, 0.5])
    assert held["theorem"]["census"]["deterministic"]["instances"] <= 50
    assert np.shape(held["learned"]["rtc_d"]["measures"]["luck"]) == (6, 2)
    assert held["rtc_d_by_fakes"]["all"] == held["learned"]["rtc_d"] != held["rtc_d_by_fakes"]["test"]


@pytest.mark.parametrize(
    ("options", "named"),
    [(["--instances", "0"], "--instances 0"), (["--seeds", "-1"], "--seeds -1"), (["--json", "/nowhere/at/all.json"], "/nowhere/at")],
)
def test_the_command_refuses_wrong_options_in_one_line(options, named):
    with pytest.raises(UsageError, match=named):
        command.main(options)
