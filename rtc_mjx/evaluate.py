"""How an agent does on its own, and what conditional type shift costs it.

Three rollouts of the same test episodes: types from each episode's own demonstration (paired), from
another episode's (shuffled), from the prior. Paired to shuffled is conditional shift, shuffled to prior is marginal shift. The
expert, and expert against expert, stand beside them: the ceiling, and the floor of every divergence (`rtc_mjx.reference`); so does the
replay of the logs, where experts are others than those of the logs.
"""

import argparse
import functools
import json
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import rich.progress
from jax import lax, random
from jaxtyping import Array, Float, Int
from rich.console import Console
from rich.table import Table

from rtc_mjx import cache, cli, dataset, metrics, reference
from rtc_mjx.config import Config
from rtc_mjx.errors import DivergedError
from rtc_mjx.files import write_whole
from rtc_mjx.keys import stream
from rtc_mjx.learner import Learner
from rtc_mjx.methods import Method
from rtc_mjx.models import Networks
from rtc_mjx.provenance import made_by, of_recordings
from rtc_mjx.pytree import Watch, in_parts, stacked
from rtc_mjx.recorded_realism import challenge
from rtc_mjx.runs import Run
from rtc_mjx.scenes import Features, Recorded, Scene
from rtc_mjx.sharding import ONE_DEVICE, Grid
from rtc_mjx.trained import trained
from rtc_mjx.trajectory import Demonstration, Trajectory

AT_ONCE = {"cpu": 128}  # rollouts simulated at once, by backend: in a CPU's caches (2,048 of driving cost three times as much there)
MANY = 2048  # on others
REACTIONS = 2048  # rollouts that say how agents react to luck turned round
FINITE = "finite"  # the feature that says whether a rollout is

Donors = dict[str, Trajectory]  # the trajectory that each episode's type is inferred from, by source of types
Roll = Callable[[Networks, Demonstration, Donors, Array], dict[str, Features]]
RollTrained = Callable[[Demonstration, Donors, Array], dict[str, Features]]


def donors(scene: Scene, method: Method, test: Demonstration) -> Donors:
    """What types are read off: an episode's own demonstration, or that of another; nothing where no type is read off any."""
    if not method.reads:
        return {}
    return {"paired": test.trajectory, "shuffled": elsewhere(scene, test.trajectory)}


def elsewhere(scene: Scene, held: Any) -> Any:
    """Of each test episode another one's (leading axis): of another recording, but where more than half of them are of one."""
    other = another(scene.groups(len(jax.tree.leaves(held)[0])))
    return jax.tree.map(lambda x: x[other], held)


def another(groups: Int[np.ndarray, "count"]) -> Int[np.ndarray, "count"]:
    """A permutation that puts one of another group in each place, as far as that can be: half the way round, group by group."""
    order = np.argsort(groups, kind="stable")
    out = np.empty(len(order), int)
    out[order] = np.roll(order, len(order) // 2)
    return out


def roller(learner: Learner, samples: int, watch: Watch = iter, grid: Grid = ONE_DEVICE) -> Roll:
    """A function (networks, test demonstrations, donors, key) -> features per type source, as numpy arrays (seeds, samples, episodes).

    Where several agents act in an episode, an axis of agents follows.

    Args:
        learner: who is tested; the networks are those of all seeds.
        samples: rollouts of each episode, every one with a type of its own.
        watch: goes through the parts of the work, such as a progress bar.
        grid: the devices that share the episodes.
    """

    def one(networks: Networks, mine: Demonstration, given: Donors, key: Array) -> dict[str, dict[str, Array]]:
        agent, scene = learner.agent(networks), learner.scene
        draw, noise = random.split(key)
        keys = scene.key_each(noise)

        def read(track: Trajectory) -> Array:
            return learner.types(learner.method.reads, agent, Demonstration(mine.episode, track, ()), draw).agent_type

        def described(g: Array) -> dict[str, Array]:
            track = learner.play(agent, mine.episode, g, keys)
            return scene.features(mine, track) | {FINITE: _finite(track)}

        types = learner.types(learner.method.test_types, agent, mine, draw).agent_type[None]
        if given:
            types = jnp.concatenate([types, lax.map(read, stacked(given.values()))])
        features = lax.map(described, types)  # sources take turns in one loop: a copy of the simulation for each would be compiled
        return {name: jax.tree.map(lambda x, i=i: x[i], features) for i, name in enumerate(["prior", *given])}

    def several(networks: Networks, held: tuple[Demonstration, Donors, Array]) -> dict[str, dict[str, Array]]:
        return jax.vmap(jax.vmap(functools.partial(one, networks), in_axes=(None, None, 0)))(*held)

    compiled = grid.over_rows(several)

    def roll(networks: Networks, test: Demonstration, given: Donors, key: Array) -> dict[str, Features]:
        count, seeds = (jax.tree.leaves(x)[0].shape[0] for x in (test, networks))
        keys = jax.vmap(lambda episode: random.split(random.fold_in(key, episode), samples))(jnp.arange(count))
        of_seeds = []
        for seed in range(seeds):
            mine = functools.partial(compiled, jax.tree.map(lambda x, i=seed: x[i], networks))
            of_seeds.append(in_parts(mine, (test, given, keys), part_size(count, samples), watch))
        return jax.tree.map(lambda *x: np.stack(x).swapaxes(1, 2), *of_seeds)

    return roll


def part_size(count: int, samples: int) -> int:
    """How many of so many episodes are simulated at once."""
    return min(count, max(1, at_once() // samples))


def at_once() -> int:
    """How many rollouts are simulated at once."""
    return AT_ONCE.get(jax.default_backend(), MANY)


def _finite(track: Trajectory) -> Array:
    return jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(track)]))


def score(config: Config, features: dict[str, Features], expert: Features) -> dict[str, dict[str, list[float]]]:
    """Metrics per type source, a list over seeds; `expert` as in `rtc_mjx.reference.experts`.

    Raises:
        DivergedError: a rollout is not finite; a mean over the others would hide it.
    """
    out: dict[str, dict[str, list[float]]] = {}
    for source, arrays in features.items():
        check_finite(arrays[FINITE], source)
        rows = [config.scene.metrics({k: v[i] for k, v in arrays.items()}, expert) for i in range(config.seeds)]
        out[source] = {name: [row[name] for row in rows] for name in rows[0]}
    return out


def check_finite(finite: np.ndarray, source: str) -> None:
    """Raises DivergedError unless all rollouts under types of a source are finite."""
    if not np.all(finite):
        raise DivergedError(f"{int(np.sum(~finite))} of {finite.size} test rollouts under {source} types are not finite")


def evaluate(run: Run, episodes: int, watch: Watch = iter) -> dict[str, Any]:
    """All of evaluation.json for a run's last whole checkpoint; `watch` goes through the parts of the work."""
    held = trained(run)
    config, learner, networks = held.config, held.learner, held.networks
    test = dataset.demonstrations(config.scene, episodes, dataset.TEST)
    roll, shown = roller(learner, config.scene.samples, watch), dataset.without_truth(test)
    given = donors(learner.scene, learner.method, shown)
    features = roll(networks, shown, given, stream("evaluation", 0))
    expert = reference.experts(config.scene, episodes)
    table = score(config, features, expert)
    means = {source: _summaries(config, features[source], expert, table[source]) for source in table}
    scene = config.scene
    recorded = {"sim_agents": challenge(scene, learner, networks, episodes, stream("evaluation", 1))} if isinstance(scene, Recorded) else {}
    recordings = {"recordings": of_recordings(lines)} if (lines := scene.recordings()) else {}
    return (
        recorded
        | recordings
        | made_by()
        | {
            "scene": config.scene.name,
            "method": config.method,
            "seeds": config.seeds,
            "episodes": next(iter(expert.values())).shape[1],
            "asked": episodes,
            "update": held.update,
            "metrics": means["prior"],
            "types": means,
            "reaction": reaction(learner, functools.partial(roll, networks), shown, features),
            "ranges": {name: list(limits) for name, limits in config.scene.ranges(expert).items()},
            "notes": {what: count for what, count in config.scene.notes(test.episode).items() if count},
            "reference": references(config.scene, episodes),
        }
    )


def references(scene: Scene, episodes: int) -> dict[str, dict[str, float]]:
    """Metrics of the experts that agents are compared with, of as many others, and of the logs themselves where these are not the first.

    A log is as near to itself as can be (minADE 0), but there is one of each episode: its divergences have a bias that those of agents,
    who drive each episode several times, do not.
    """
    expert, second = reference.both(scene, episodes)
    log = reference.log_replay(scene, episodes)
    held = {"expert": expert, "expert_vs_expert": second} | ({} if log is None else {"log_replay": log})
    return {who: scene.metrics(features, expert) for who, features in held.items()}


def reaction(learner: Learner, roll: RollTrained, shown: Demonstration, features: dict[str, Features]) -> dict[str, dict[str, float]]:
    """The means over seeds of what `reactions` says of rollouts of an evaluation."""
    told = reactions(learner, roll, shown, features, stream("evaluation", 0))
    return {who: {name: float(np.mean(values)) for name, values in shares.items()} for who, shares in told.items()}


def reactions(
    learner: Learner, roll: RollTrained, shown: Demonstration, features: dict[str, Features], key: Array
) -> dict[str, dict[str, list[float]]]:
    """What agents do when luck is turned round at the same type, beside the experts with the same minds.

    On the first episodes, as many as `REACTIONS` are rollouts of; `key` is that of the rollouts that `features` are of.

    Returns:
        By who acts: `as_it_was` and `flipped`, the share that did what luck bears on, and `like_expert`, the share whose decision
        in the flipped episode is that of its expert; each a list over seeds (of one value for experts). Empty where the scene has
        nothing to turn.
    """
    scene = learner.scene
    if scene.flipped(shown.episode) is None:
        return {}
    count = min(len(jax.tree.leaves(shown)[0]), max(1, REACTIONS // scene.samples))
    again = dataset.without_truth(dataset.redriven(scene, count, dataset.TEST, scene.flipped))
    first = jax.tree.map(lambda x: x[:count], shown)
    theirs, before = (reference.expert_features(scene, held)["decided"] for held in (again, first))
    given = jax.tree.map(lambda x: x[:count], donors(scene, learner.method, shown))
    flipped = roll(Demonstration(again.episode, first.trajectory, ()), given, key)

    def told(before: np.ndarray, after: np.ndarray) -> dict[str, list[float]]:
        shares = {"as_it_was": before, "flipped": after, "like_expert": after == theirs}
        return {name: [float(np.mean(of_seed)) for of_seed in values] for name, values in shares.items()}

    ours = {source: told(features[source]["decided"][:, :, :count], flipped[source]["decided"]) for source in flipped}
    return ours | {"expert": told(before[None], theirs[None])}


def _summaries(config: Config, features: Features, expert: Features, values: dict[str, list[float]]) -> dict[str, dict[str, Any]]:
    """Of each metric: per seed, mean, standard deviation, and a bootstrap interval of the mean over groups of test episodes."""
    seeds = [{name: x[i] for name, x in features.items()} for i in range(config.seeds)]
    low, high = intervals(config.scene, seeds, expert)
    out = {}
    for (name, per_seed), *interval in zip(values.items(), low, high, strict=True):
        spread = float(np.std(per_seed, ddof=1)) if len(per_seed) > 1 else 0.0
        out[name] = {"per_seed": per_seed, "mean": float(np.mean(per_seed)), "std": spread, "interval": [float(x) for x in interval]}
    return out


def intervals(
    scene: Scene, populations: Sequence[Features], expert: Features
) -> tuple[Float[np.ndarray, "metrics"], Float[np.ndarray, "metrics"]]:
    """Both ends of the 95 % interval, over groups of test episodes, of each metric's mean over populations (samples, episodes, ...)."""
    ranges, groups = scene.ranges(expert), scene.groups(next(iter(expert.values())).shape[1])

    def means(rows: np.ndarray) -> np.ndarray:
        theirs = {k: v[:, rows] for k, v in expert.items()}
        drawn = [{k: v[:, rows] for k, v in ours.items()} for ours in populations]
        return np.mean([list(scene.metrics(d, theirs, ranges).values()) for d in drawn], axis=0)

    return metrics.bootstrap(np.arange(len(groups)), means, draws=200, biased=True, groups=groups)


def table(result: dict[str, Any]) -> Table:
    """The result for the terminal."""
    out = Table(title=f"{result['method']} on {result['scene']}: {result['seeds']} seeds, {result['episodes']} episodes")
    out.add_column("types")
    names = list(result["metrics"])
    for name in names:
        out.add_column(name, justify="right")
    for source, summary in result["types"].items():
        out.add_row(
            source, *(f"{s['mean']:.4g} ± {s['std']:.2g}  [{s['interval'][0]:.4g}, {s['interval'][1]:.4g}]" for s in summary.values())
        )
    for who, values in result["reference"].items():
        out.add_row(who.replace("_", " "), *(f"{values[name]:.4g}" for name in names))
    return out


def likeness(figures: dict[str, Any]) -> Table:
    """The Sim Agents figures of recorded scenes for the terminal: the agent's, mean over seeds, beside what log replay scores."""
    out = Table("Sim Agents figure", "prior types", "log replay", title="realism on recorded scenes (only the controlled agent is scored)")
    for name, ceiling in figures["log_replay"].items():
        ours = [seed[name] for seed in figures["prior"] if name in seed]
        out.add_row(name.replace("_", " "), f"{np.mean(ours):.4g}" if ours else "-", f"{ceiling:.4g}")
    return out


def progress(what: str) -> Watch:
    """A progress bar on a terminal's standard error; elsewhere it says on it when a tenth more is done."""
    if sys.stderr.isatty():
        return functools.partial(rich.progress.track, description=what, console=Console(stderr=True))

    def lines(parts: Sequence[Any]) -> Iterable[Any]:
        for number, part in enumerate(parts, 1):
            yield part
            if number * 10 // len(parts) > (number - 1) * 10 // len(parts):
                sys.stderr.write(f"{what} {number}/{len(parts)}\n")

    return lines


def main(argv: Sequence[str] | None = None) -> None:
    """Evaluates a run."""
    parser = cli.Parser(prog="python -m rtc_mjx.evaluate", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, metavar="DIR", help="the run directory; its last checkpoint is evaluated")
    parser.add_argument("--episodes", type=int, metavar="N", help="test episodes (default: experts.test of the run)")
    options = parser.parse_args(argv)
    if options.episodes is not None:
        cli.at_least(4, episodes=options.episodes)
    cache.keep_compiled()
    run = Run.open(options.run)
    result = evaluate(run, options.episodes or run.config.experts.test, progress("rollouts"))
    console = cli.console()
    console.print(table(result))
    if "sim_agents" in result:
        console.print(likeness(result["sim_agents"]))
    for who, shares in result["reaction"].items():
        told = ", ".join(f"{name.replace('_', ' ')} {share:.3f}" for name, share in shares.items())
        console.print(f"luck turned round, {who}: {told}")
    for what, count in result["notes"].items():
        console.print(f"{count} {what}")
    write_whole(run.folder / "evaluation.json", json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    cli.run(main)
