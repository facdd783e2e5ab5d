"""What types carry, and what that costs: `python -m rtc_mjx.type_shift --run DIR` (method notes, section 7).

    test episodes, each also driven by other experts -> rollouts under the prior's types and inferred ones: an episode's own, another
    expert's in the same episode, another episode's -> conditional shift is what the last costs beyond the one before
    those under another episode's types -> apart by what luck let the two experts do
    types, xi and the experts' minds -> probes of I(g; xi) and I(g; mind), each beside its permutation null
    rollouts -> encoded again: do they show the type they were played under?
    many experts and many rollouts of one episode -> conditional realism: p(tau|xi) compared feature by feature, beside its noise floor

Everything is in bits, rates or the scene's own units, per seed of the run.
"""

import argparse
import functools
import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random
from jaxtyping import Array
from rich.table import Table

from rtc_mjx import cache, cli, dataset, evaluate, metrics, reference
from rtc_mjx.agent_types import SOURCES
from rtc_mjx.errors import UsageError
from rtc_mjx.files import write_whole
from rtc_mjx.keys import stream
from rtc_mjx.models import Networks
from rtc_mjx.probe import information
from rtc_mjx.provenance import made_by
from rtc_mjx.runs import Run
from rtc_mjx.scenes import Scene, merged
from rtc_mjx.trained import Trained, trained
from rtc_mjx.trajectory import Demonstration, Trajectory

REALISM_BINS, REALISM_EPISODES = 10, 64
SAID = {True: "yes", False: "no"}
LEAST_EPISODES = 16  # a probe learns from half of them and is measured on a quarter


@dataclass(frozen=True)
class Setup(Trained):
    """A trained run with the test episodes of its analysis.

    Attributes:
        test: test demonstrations, without the truth.
        truth: the experts' minds.
    """

    test: Demonstration
    truth: Any


def set_up(run: Run, episodes: int) -> Setup:
    """Loads the run's last whole checkpoint, and test episodes."""
    test = dataset.demonstrations(run.config.scene, episodes, dataset.TEST)
    return Setup(**vars(trained(run)), test=dataset.without_truth(test), truth=test.truth)


def analyse(run: Run, episodes: int, experts: int, progress: Callable[[str], evaluate.Watch] = lambda what: iter) -> dict[str, Any]:
    """All of type_shift.json.

    Args:
        run: trained.
        episodes: test episodes.
        experts: of each episode, and rollouts, that conditional realism compares.
        progress: of a piece of work by name, goes through its parts.
    """
    setup = set_up(run, episodes)
    count = len(jax.tree.leaves(setup.test)[0])
    if count < LEAST_EPISODES:
        raise UsageError(f"{run.folder}: its scene has {count} test episodes; at least {LEAST_EPISODES} are needed")
    out: dict[str, Any] = made_by() | {
        "scene": setup.config.scene.name,
        "method": setup.config.method,
        "seeds": setup.config.seeds,
        "episodes": count,
        "update": setup.update,
    }
    if setup.config.scene.redrivable:
        out["realism"] = realism(setup, min(episodes, REALISM_EPISODES), experts, progress("conditional realism"))
    if not setup.learner.method.encodes:
        return out
    features, expert = played(setup, progress("types"))
    types, luck = (
        evaluate.score(setup.config, features, reference.experts(setup.config.scene, episodes)),
        by_luck(setup.config.scene, features["shuffled"], expert),
    )
    return out | {"types": types, "by_luck": luck, "information": told_by_types(setup), "reencoding": reencoding(setup)}


def played(setup: Setup, watch: evaluate.Watch = iter) -> tuple[dict[str, evaluate.Features], evaluate.Features]:
    """Features of rollouts per source of types, 'prior', 'paired', 'same_xi', 'shuffled', and of the experts."""
    scene, test = setup.config.scene, setup.test
    given = evaluate.donors(setup.learner.method, test)
    if scene.redrivable:
        others = dataset.by_others(scene, len(jax.tree.leaves(test)[0]), dataset.TEST, 1)
        given["same_xi"] = jax.tree.map(lambda x: x[:, 0], others.trajectory)
    features = evaluate.roller(setup.learner, scene.samples, watch)(setup.networks, test, given, stream("type shift", 0))
    return features, reference.expert_features(scene, test)


def by_luck(scene: Scene, shuffled: evaluate.Features, expert: evaluate.Features) -> dict[str, dict[str, Any]]:
    """Shuffled types by what luck let two experts do (`decided`): that of the type's own episode, and that of the episode it is played in.

    Where both agree, luck and type match by chance; a difference among the others is conditional shift, and which way it goes.

    Returns:
        By 'type yes, episode no' and so on: the number of `agents`, and a list over seeds of the scene's first main metric.
    """
    here = expert["decided"].astype(bool)
    there = evaluate.elsewhere(here)
    seeds = range(len(shuffled["decided"]))
    arrays = {name: x for name, x in shuffled.items() if name != evaluate.FINITE}
    metric, out = scene.main_metrics[0], {}
    for of_type, own in itertools.product((True, False), repeat=2):
        rows = (there == of_type) & (here == own)
        theirs = {name: x[rows] for name, x in expert.items()}
        values = [scene.metrics({name: x[i][:, rows] for name, x in arrays.items()}, theirs)[metric] for i in seeds] if np.any(rows) else []
        out[f"type {SAID[of_type]}, episode {SAID[own]}"] = {"agents": int(np.sum(rows)), metric: values}
    return out


def inferred(setup: Setup) -> np.ndarray:
    """A type drawn from the encoder for each agent of each test demonstration: (seeds, rows, size)."""
    rows = setup.learner.by_agent(setup.test)

    def one(networks: Networks, held: Demonstration, key: Array) -> Array:
        return SOURCES["encoder"](setup.learner.agent(networks), held, key).agent_type

    keys = random.split(stream("type shift", 1), len(jax.tree.leaves(rows)[0]))
    draw = jax.jit(lambda networks, test: lax.map(lambda n: jax.vmap(functools.partial(one, n))(test, keys), networks))
    return np.asarray(draw(setup.networks, rows))


def told_by_types(setup: Setup) -> dict[str, dict[str, Any]]:
    """Bits that types tell of xi, which they should not, and of the expert's mind, which they should; with the null of each."""
    luck = np.asarray(jax.jit(jax.vmap(setup.config.scene.luck))(setup.learner.by_agent(setup.test).episode))
    told = {"xi": luck}
    minds = jax.tree.leaves(merged(setup.config.scene, setup.truth))
    if minds:  # nobody knows what logged drivers had in mind
        told["mind"] = np.stack([np.asarray(x, float) for x in minds], axis=1)
    types = inferred(setup)
    out = {}
    for name, of in told.items():
        found = [information(g, of) for g in types]
        null = np.concatenate([values for _, values in found])
        out[name] = {"bits": [bits for bits, _ in found], "null_mean": float(np.mean(null)), "null_95": float(np.percentile(null, 95))}
    return out


def reencoding(setup: Setup) -> dict[str, list[float]]:
    """Bits by which a trajectory tells its type from the prior's others, per seed.

    The median of log2 e(g|tau) / p(g) of the demonstration that g was inferred from, of the rollout under g in its episode, and of one
    under g in another episode. What a type means is kept where the last two come near the first.
    """

    def one(networks: Networks, mine: Demonstration, elsewhere: Demonstration, key: Array) -> dict[str, Array]:
        agent, scene = setup.learner.agent(networks), setup.config.scene
        draw, noise = random.split(key)
        g, first = setup.learner.types("encoder", agent, mine, draw).agent_type, scene.apart(mine.trajectory).observations[..., 0, :]

        def bits(track: Trajectory, g: Array, first: Array) -> Array:
            return (agent.posterior(track).log_prob(g) - agent.prior(first).log_prob(g)) / jnp.log(2.0)

        def told(track: Trajectory) -> Array:
            return scene.each(bits)(scene.apart(track), g, first)

        tracks = {"rollout": mine.episode, "rollout_elsewhere": elsewhere.episode}
        return {"demonstration": told(mine.trajectory)} | {
            name: told(setup.learner.play(agent, episode, g, scene.key_each(noise))) for name, episode in tracks.items()
        }

    test = setup.test
    other = evaluate.elsewhere(test)
    keys = random.split(stream("type shift", 2), len(jax.tree.leaves(test)[0]))
    run = jax.jit(
        lambda networks: lax.map(
            lambda n: lax.map(lambda held: one(n, *held), (test, other, keys), batch_size=min(len(keys), evaluate.AT_ONCE)), networks
        )
    )
    # a rollout that leaves what the encoder knows may be told from its type by thousands of bits: the median is not moved by it
    return {name: [float(np.median(of_seed)) for of_seed in values] for name, values in jax.device_get(run(setup.networks)).items()}


def realism(setup: Setup, episodes: int, experts: int, watch: evaluate.Watch = iter) -> dict[str, Any]:
    """Conditional realism: JSD in bits between p(tau|xi) of experts and of the agent, per feature, mean over episodes.

    Returns:
        By feature: `agent`, a list over seeds, `floor`, the same between two groups of experts of the same size, and the `range` of
        the bins.

    Raises:
        RunError: a rollout is not finite.
    """
    scene = setup.config.scene
    held = jax.tree.map(lambda x: x[:episodes], setup.test)
    others = dataset.without_truth(dataset.by_others(scene, episodes, dataset.TEST, 2 * experts))
    theirs = jax.device_get(_described(scene, held, others))
    ours = evaluate.roller(setup.learner, experts, watch)(setup.networks, held, {}, stream("type shift", 3))["prior"]
    evaluate.check_finite(ours[evaluate.FINITE], "prior")
    if scene.agents > 1:  # each agent by itself: of (episodes, experts, agents, ...) and (seeds, rollouts, episodes, agents, ...)
        theirs = {name: merged(scene, x.swapaxes(1, 2)) for name, x in theirs.items()}
        ours = {name: x.reshape(*x.shape[:2], -1, *x.shape[4:]) for name, x in ours.items() if x.ndim > 3}
    features = {name: compared(ours[name], theirs[name]) for name in scene.described_by}
    return {"episodes": episodes, "experts": experts, "features": features}


def compared(ours: np.ndarray, theirs: np.ndarray) -> dict[str, Any]:
    """One feature of rollouts (seeds, rollouts, episodes, ...) and of twice as many experts (episodes, experts, ...), compared.

    Returns:
        As `realism` says, of one feature.

    The bins span what both do, since experts may all do the same: compare runs by figures of one range.
    """
    count = theirs.shape[1] // 2
    first, second = theirs[:, :count], theirs[:, count:]
    both = np.concatenate([np.ravel(x).astype(float) for x in (theirs, ours)])
    limits = (float(both.min()), float(max(both.max(), both.min() + 1e-6)))
    mean = functools.partial(_mean_jsd, limits=limits)
    return {"agent": [mean(of_seed.swapaxes(0, 1), first) for of_seed in ours], "floor": mean(second, first), "range": limits}


def _described(scene: Scene, held: Demonstration, others: Demonstration) -> dict[str, Array]:
    """Features of other experts' trajectories in the episodes of demonstrations: (episodes, experts)."""

    def one(mine: Demonstration, tracks: Trajectory) -> dict[str, Array]:
        return jax.vmap(lambda track: scene.features(mine, track))(tracks)

    return jax.jit(lambda mine, tracks: lax.map(lambda held: one(*held), (mine, tracks)))(held, others.trajectory)


def _mean_jsd(ours: np.ndarray, theirs: np.ndarray, limits: tuple[float, float]) -> float:
    """Mean over episodes (rows) of the divergence between two samples of each."""
    return float(np.mean([metrics.jsd(a, b, bins=REALISM_BINS, limits=limits) for a, b in zip(ours, theirs, strict=True)]))


def tables(result: dict[str, Any]) -> list[Table]:
    """The result for the terminal."""
    out = []
    if "types" in result:
        first = Table("types", *next(iter(result["types"].values())), title="rollouts by source of types")
        for source, values in result["types"].items():
            first.add_row(source, *(_spread(x) for x in values.values()))
        second = Table("types tell of", "bits", "null, mean", "null, 95 %", title="mutual information, held out")
        for name, of in result["information"].items():
            second.add_row(name, _spread(of["bits"]), f"{of['null_mean']:.3f}", f"{of['null_95']:.3f}")
        third = Table("trajectory", "bits", title="how well a trajectory shows its type (median)")
        for name, bits in result["reencoding"].items():
            third.add_row(name.replace("_", " "), _spread(bits))
        metric = list(next(iter(result["by_luck"].values())))[-1]
        fourth = Table("did luck let the expert?", "agents", metric, title="shuffled types: of the type, and of the episode")
        for name, of in result["by_luck"].items():
            fourth.add_row(name, str(of["agents"]), _spread(of[metric]) if of[metric] else "-")
        out += [first, fourth, second, third]
    if "realism" not in result:
        return out
    last = Table("feature", "agent", "floor", title="conditional realism: JSD of p(tau|xi) from the experts', bits")
    for name, values in result["realism"]["features"].items():
        last.add_row(name, _spread(values["agent"]), f"{values['floor']:.4f}")
    return [*out, last]


def _spread(values: Sequence[float]) -> str:
    return f"{np.mean(values):.4g} ± {np.std(values, ddof=1):.2g}" if len(values) > 1 else f"{values[0]:.4g}"


def figure(result: dict[str, Any], metric: str, file: Path) -> None:
    """Three panels: the main metric by source of types, what types tell, conditional realism beside its floor."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    canvas, axes = pyplot.subplots(1, 3, figsize=(11, 3.2))
    panels = [
        (result["types"], lambda held: held[metric], metric.replace("_", " ")) if "types" in result else None,
        (result["information"], lambda held: held["bits"], "types tell of, bits") if "information" in result else None,
        (result["realism"]["features"], lambda held: held["agent"], "conditional realism: JSD, bits") if "realism" in result else None,
    ]
    for axis, panel in zip(axes, panels, strict=True):
        if panel is None:
            axis.axis("off")
            continue
        held, pick, title = panel
        for place, values in enumerate(held.values()):
            seeds = np.asarray(pick(values))
            axis.bar(place, np.mean(seeds), color="0.75", width=0.6)
            axis.plot(np.full(len(seeds), place), seeds, "k.", markersize=4)
            for key, style in (("null_95", "--"), ("floor", "--")):
                if key in values:
                    axis.plot([place - 0.3, place + 0.3], [values[key]] * 2, "k" + style, linewidth=1)
        axis.set_xticks(range(len(held)), [name.replace("_", "\n") for name in held], fontsize=8)
        axis.set_title(title, fontsize=10)
        axis.grid(alpha=0.25, axis="y")
    canvas.suptitle(f"{result['method']} on {result['scene']}: dots are seeds, dashed the null (95 %) or the floor", fontsize=9)
    canvas.tight_layout()
    canvas.savefig(file, dpi=150)
    pyplot.close(canvas)


def main(argv: Sequence[str] | None = None) -> None:
    """Analyses a run."""
    parser = cli.Parser(prog="python -m rtc_mjx.type_shift", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, metavar="DIR", help="the run directory; its last checkpoint is analysed")
    parser.add_argument("--episodes", type=int, metavar="N", help="test episodes (default: experts.test of the run)")
    parser.add_argument("--experts", type=int, default=32, metavar="M", help="experts, and rollouts, of an episode in conditional realism")
    options = parser.parse_args(argv)
    run = Run.open(options.run)
    episodes = run.config.experts.test if options.episodes is None else options.episodes
    if episodes < LEAST_EPISODES:
        raise UsageError(f"--episodes {episodes}: at least {LEAST_EPISODES} are needed")
    if options.experts < 2:
        raise UsageError(f"--experts {options.experts}: at least 2 are needed")
    cache.keep_compiled()
    result = analyse(run, episodes, options.experts, evaluate.progress)
    console = cli.console()
    for part in tables(result):
        console.print(part)
    write_whole(run.folder / "type_shift.json", json.dumps(result, indent=1) + "\n")
    if not {"types", "realism"} & set(result):
        return  # no types, and recorded episodes have one expert each
    (run.folder / "media").mkdir(exist_ok=True)
    figure(result, run.config.scene.main_metrics[0], run.folder / "media" / "type_shift.png")


if __name__ == "__main__":
    cli.run(main)
