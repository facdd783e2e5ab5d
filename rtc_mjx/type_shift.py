"""What types carry, and what that costs: `python -m rtc_mjx.type_shift --run DIR`.

    test episodes, each also driven by other experts -> rollouts under the prior's types and those read off a trajectory: an episode's own,
    another expert's in the same episode, another episode's -> conditional shift is what the last costs beyond the one before
    those under another episode's types -> apart by what luck let the two experts do (`carried`)
    the same episodes with luck turned round, at the same types -> the reaction, beside that of the same experts (`evaluate.reactions`)
    fresh demonstrations: types, xi and the experts' minds -> probes of I(g; xi) and I(g; mind), each beside its permutation null
    rollouts -> read again: do they show the type they were played under?
    many experts and many rollouts of one episode -> conditional realism (`realism`)

Everything is in bits, rates or the scene's own units, per seed of the run; docs/metrics.md defines each figure.
"""

import argparse
import functools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rtc_mjx import cache, cli, dataset, evaluate, reference, shift_report
from rtc_mjx.carried import LEAST_EPISODES, by_luck, reencoding, told_by_types
from rtc_mjx.errors import UsageError
from rtc_mjx.files import write_whole
from rtc_mjx.keys import stream
from rtc_mjx.probe import ProbeOptions
from rtc_mjx.provenance import made_by
from rtc_mjx.pytree import Watch
from rtc_mjx.realism import realism
from rtc_mjx.runs import Run
from rtc_mjx.trained import Trained, trained
from rtc_mjx.trajectory import Demonstration

FILE = "type_shift.json"
LEAST_TESTS = 4
PROBE = ProbeOptions()
Progress = Callable[[str], Watch]


def analyse(run: Run, episodes: int, experts: int, probed: int, progress: Progress = lambda what: iter) -> dict[str, Any]:
    """All of type_shift.json.

    Args:
        run: trained.
        episodes: test episodes.
        experts: of each episode, and rollouts, that conditional realism compares.
        probed: fresh demonstrations that the probe learns from and is measured on.
        progress: of a piece of work by name, goes through its parts.

    Raises:
        UsageError: the scene has too few test episodes.
    """
    held = trained(run)
    scene = held.config.scene
    test = dataset.without_truth(dataset.demonstrations(scene, episodes, dataset.TEST))
    count = len(jax.tree.leaves(test)[0])
    if count < LEAST_TESTS:
        raise UsageError(f"{run.folder}: its scene has {count} test episodes; at least {LEAST_TESTS} are needed")
    out: dict[str, Any] = made_by() | {
        "scene": scene.name,
        "method": held.config.method,
        "metric": scene.main_metrics[0],
        "seeds": held.config.seeds,
        "update": held.update,
        "episodes": count,
        "asked": episodes,
        "experts": experts,
        "probed": probed,
        "left_out": {},
    }
    if scene.redrivable:
        out["realism"] = realism(held, test, experts, progress("conditional realism"))
    else:
        out["left_out"]["realism"] = "recorded episodes have one expert each"
    if not held.learner.method.reads:
        out["left_out"]["types"] = "no types are read off trajectories"
        return out
    return out | of_types(held, test, progress("types")) | _probed(held, probed, out["left_out"])


def of_types(held: Trained, test: Demonstration, watch: Watch) -> dict[str, Any]:
    """Rollouts per source of types, 'prior', 'paired', 'same_xi' and 'shuffled', and what they are made to tell."""
    scene, learner, key = held.config.scene, held.learner, stream("type shift", 0)
    given, roll = evaluate.donors(scene, learner.method, test), evaluate.roller(learner, scene.samples, watch)
    if scene.redrivable:
        others = dataset.by_others(scene, len(jax.tree.leaves(test)[0]), dataset.TEST, 1)
        given["same_xi"] = jax.tree.map(lambda x: x[:, 0], others.trajectory)
    features = roll(held.networks, test, given, key)
    out = {
        "types": evaluate.score(held.config, features, reference.experts(scene, len(jax.tree.leaves(test)[0]))),
        "by_luck": by_luck(scene, features["shuffled"], reference.expert_features(scene, test)),
        "reencoding": reencoding(held, test),
    }
    told = evaluate.reactions(learner, functools.partial(roll, held.networks), test, features, key)
    return out | ({"reaction": told} if told else {})


def _probed(held: Trained, count: int, left_out: dict[str, str]) -> dict[str, Any]:
    """The probes, on demonstrations that are fresh; recordings are only so in the test part."""
    seed = dataset.PROBED if held.config.scene.redrivable else dataset.TEST
    fresh = dataset.demonstrations(held.config.scene, count, seed)
    there = len(jax.tree.leaves(fresh)[0])
    if there < LEAST_EPISODES:
        left_out["information"] = f"a probe needs {LEAST_EPISODES} demonstrations; the scene has {there} that it did not learn from"
        return {"information": {}}
    by_group = np.argsort(held.config.scene.groups(there), kind="stable")  # a recording is in one part of the probe, or at an edge in two
    fresh = jax.tree.map(lambda x: x[by_group], fresh)
    return told_by_types(held, dataset.without_truth(fresh), fresh.truth, PROBE)


def figure(result: dict[str, Any], file: Path) -> None:
    """All that a run's result says."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(12, 6.4), layout="constrained")
    shift_report.draw(canvas, {result["method"]: result})
    canvas.suptitle(f"{result['method']} on {result['scene']}: large the mean over seeds, small the seeds", fontsize=10)
    canvas.savefig(file, dpi=150)


def main(argv: Sequence[str] | None = None) -> None:
    """Analyses a run."""
    parser = cli.Parser(prog="python -m rtc_mjx.type_shift", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, metavar="DIR", help="the run directory; its last checkpoint is analysed")
    parser.add_argument("--episodes", type=int, metavar="N", help="test episodes (default: experts.test of the run)")
    parser.add_argument(
        "--experts", type=int, default=32, metavar="M", help="experts, and rollouts, of an episode in conditional realism (default: 32)"
    )
    parser.add_argument("--probe", type=int, default=4096, metavar="P", help="fresh demonstrations for the probes (default: 4096)")
    options = parser.parse_args(argv)
    run = Run.open(options.run)
    episodes = run.config.experts.test if options.episodes is None else options.episodes
    cli.at_least(LEAST_TESTS, episodes=episodes)
    cli.at_least(2, experts=options.experts)
    cli.at_least(LEAST_EPISODES, probe=options.probe)
    cache.keep_compiled()
    result = analyse(run, episodes, options.experts, options.probe, evaluate.progress)
    console = cli.console()
    for part in shift_report.tables(result):
        console.print(part)
    for part, why in result["left_out"].items():
        console.print(f"no {part}: {why}")
    write_whole(run.folder / FILE, json.dumps(result, indent=1) + "\n")
    (run.folder / "media").mkdir(exist_ok=True)
    figure(result, run.folder / "media" / "type_shift.png")


if __name__ == "__main__":
    cli.run(main)
