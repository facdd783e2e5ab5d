"""Tables of results in Markdown: methods side by side, paired tests, what types carry, conditional realism, variations of RTC.

Under each stands the command that makes its rows, the commit they were made at, and what differs from the committed settings.
"""

import shlex
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from rtc_mjx import over_seeds, results, shift_report
from rtc_mjx.methods import METHODS
from rtc_mjx.over_seeds import number, signed
from rtc_mjx.results import Record, markdown
from rtc_mjx.scenes import scene_type

SOURCES = ("paired", "shuffled", "prior")  # of types
NAIVE = {"continuous": "naive_hierarchy_c", "discrete": "naive_hierarchy_d"}
OVER_SEEDS = "Mean ± standard deviation over seeds [95 % t interval of the mean over seeds, from 0 on where no seed is below]."
TESTED = (
    f"Sign-flip tests are two-sided; with fewer than {over_seeds.DECIDING} seeds no p can be below 0.05. "
    "Holm's correction is for all tests of one metric in the table."
)

SIM_AGENTS = (
    "realism_meta_metric", "kinematic", "interactive", "map_based",
    "simulated_collision_rate", "simulated_offroad_rate", "min_average_displacement_error",
)  # fmt: skip

Held = Mapping[str, Record]


def performance(held: Held, study: str) -> str:
    """A row for each source of types of each method; the expert below. What came to nothing has a row that says so."""
    whole = results.methods(results.finished(held))
    if not whole:
        return ""
    first = next(iter(whole.values()))
    names = list(first["metrics"])
    rows: list[list[str]] = [["method", "types", *names]]
    for name, record in results.methods(held).items():
        if "failed" in record:
            rows.append([name, record["failed"], *[""] * len(names)])
            continue
        for source in [source for source in SOURCES if source in record["types"]]:
            summary = record["types"][source]
            rows.append([name, source, *(number(summary[n]["per_seed"], spread=True) if n in summary else "" for n in names)])
    rows += [[who.replace("_", " "), "", *(_plain(values.get(n)) for n in names)] for who, values in first["reference"].items()]
    told = (
        f"Scene {first['scene']}; {_sizes(whole.values())}. {OVER_SEEDS} Intervals over test episodes are in the JSON files (`interval`)."
    )
    return markdown(rows, left=2) + f"\n{told}\n\n{made_by(whole, study)}"


def comparisons(held: Held, study: str) -> str:
    """Paired tests over seeds, under prior types, of every method against MGAIL, the naive hierarchy of its kind, and Symphony."""
    whole = results.methods(results.finished(held))
    tests: list[tuple[str, str, str, np.ndarray]] = []
    for name in whole:
        for against in [other for other in _references(name) if other in whole and results.comparable(whole[name], whole[other])]:
            for metric in [metric for metric in whole[name]["metrics"] if metric in whole[against]["metrics"]]:
                ours, theirs = (results.metric(whole[n], "prior", metric) for n in (name, against))
                tests.append((name, against, metric, over_seeds.paired(ours, theirs)))
    tests = [test for test in tests if len(test[3]) > 1]
    if not tests:
        return ""
    p = [over_seeds.sign_flip(differences) for *_, differences in tests]
    corrected = _by_family([metric for _, _, metric, _ in tests], p)
    rows = [["method", "against", "metric", "seeds", "difference [95 % interval]", "p (sign-flip)", "p (Holm)"]]
    for (name, against, metric, differences), raw, holm in zip(tests, p, corrected, strict=True):
        rows.append([name, against, metric, str(len(differences)), signed(differences.tolist()), f"{raw:.3g}", f"{holm:.3g}"])
    return markdown(rows, left=3) + f"\nPaired by the number of the seed, under prior types. {TESTED}\n\n{made_by(whole, study)}"


def _references(name: str) -> list[str]:
    """What a method is compared with."""
    kind = METHODS[name].kind if name in METHODS else "none"
    return [other for other in ("mgail", NAIVE.get(kind, ""), "symphony") if other and other != name]


def _by_family(families: Sequence[str], p: Sequence[float]) -> list[float]:
    """Holm's correction within each family of tests."""
    out = list(p)
    for family in set(families):
        rows = [row for row, of in enumerate(families) if of == family]
        for row, corrected in zip(rows, over_seeds.holm([p[row] for row in rows]), strict=True):
            out[row] = corrected
    return out


def type_shift(held: Held, study: str) -> str:
    """What types carry and what that costs: methods that infer types, of those that `type_shift` has analysed."""
    whole = {name: record for name, record in results.methods(results.finished(held)).items() if "types" in record.get("type_shift", {})}
    if not whole:
        return ""
    metric = scene_type(next(iter(whole.values()))["scene"]).main_metrics[0]
    shifts = ["conditional shift", "marginal shift", "told of xi, bit", "null", "told of mind, bit", "null"]
    rows = [["method", *(f"{metric}, {source}" for source in shift_report.SOURCES), *shifts]]
    for name, record in whole.items():
        rows.append([name, *_shift_cells(record["type_shift"], metric)])
    told = (
        "Types of the episode's own demonstration (paired), of another expert in the same episode (same_xi), of another episode "
        "(shuffled), of the prior. Conditional shift: shuffled less same_xi, or less paired where nobody else can drive the episode; "
        f"marginal: prior less shuffled. Bits by a held-out probe, a lower bound; null: 95 % of permutations are below. {OVER_SEEDS}"
    )
    return markdown(rows, left=1) + f"\n{told}\n\n{made_by(_as_analysed(whole), study)}"


def _as_analysed(held: Held) -> Held:
    """Results with the code that analysed their types, which may be another than the one that evaluated them."""
    ours = ("commit", "measured_by")
    return {
        name: {**record, **{key: record["type_shift"][key] for key in ours if key in record["type_shift"]}} for name, record in held.items()
    }


def _shift_cells(found: Mapping[str, Mapping], metric: str) -> list[str]:
    values = {source: np.array(found["types"][source][metric]) for source in shift_report.SOURCES if source in found["types"]}
    base = values.get("same_xi", values["paired"])
    cells = [number(values[source].tolist(), spread=True) if source in values else "" for source in shift_report.SOURCES]
    cells += [signed((values["shuffled"] - base).tolist()), signed((values["prior"] - values["shuffled"]).tolist())]
    for of in ("xi", "mind"):
        bits = found["information"].get(of)
        cells += [number(bits["bits"], spread=True), f"{bits['null_95']:.3g}"] if bits else ["", ""]
    return cells


def conditional_realism(held: Held, study: str) -> str:
    """p(tau|xi) of many rollouts against many experts in the same episodes: a row for each method and variation, with its noise floor."""
    whole = {name: record for name, record in results.finished(held).items() if "realism" in record.get("type_shift", {})}
    if not whole:
        return ""
    first = next(iter(whole.values()))["type_shift"]["realism"]
    features = list(first["features"])
    rows = [["method", *(word for feature in features for word in (feature, "floor"))]]
    for name, record in whole.items():
        found = record["type_shift"]["realism"]["features"]
        cells = [(number(found[f]["agent"], spread=True), _plain(found[f]["floor"])) if f in found else ("", "") for f in features]
        rows.append([name, *(word for words in cells for word in words)])
    told = (
        f"JSD in bits between {first['experts']} experts and as many rollouts under prior types in one episode, mean over "
        f"{first['episodes']} episodes. Floor: the same between two groups of experts, in the bins of that row. {OVER_SEEDS}"
    )
    return markdown(rows, left=1) + f"\n{told}\n\n{made_by(_as_analysed(whole), study)}"


def sim_agents(held: Held, study: str) -> str:
    """The Sim Agents figures of methods on recorded scenes, under prior types, beside what log replay scores."""
    whole = {name: record for name, record in results.methods(results.finished(held)).items() if "sim_agents" in record}
    if not whole:
        return ""
    rows = [["method", *(name.replace("_", " ") for name in SIM_AGENTS)]]
    for name, record in whole.items():
        values = [[seed[figure] for seed in record["sim_agents"]["prior"] if figure in seed] for figure in SIM_AGENTS]
        rows.append([name, *(number(found, spread=True) if found else "" for found in values)])
    first = next(iter(whole.values()))
    rows.append(["log replay", *(_plain(first["sim_agents"]["log_replay"].get(figure)) for figure in SIM_AGENTS)])
    others = [name for name, record in whole.items() if not results.comparable(record, first)]
    told = "Only the controlled agent is scored, under types of the prior (docs/metrics.md); log replay: in the scenes of the first row. "
    told += f"Tested on other recordings than the first row: {', '.join(others)}. " if others else ""
    return markdown(rows, left=1) + f"\n{told}{OVER_SEEDS}\n\n{made_by(whole, study)}"


def ablations(held: Held, study: str) -> str:
    """Variations of RTC's parts against the method itself: paired differences and tests over seeds."""
    varied = {name: record for name, record in held.items() if "," in name}
    if not varied:
        return ""
    metrics, whole = _ablated(held), results.finished(held)
    rows = [["variation", "seeds", *(word for m in metrics for word in (m, "difference", "p (Holm)"))]]
    tested: list[tuple[int, str, float]] = []  # row, metric, p
    for base in dict.fromkeys(name.partition(",")[0] for name in varied):
        if base in whole:
            rows.append([base, str(whole[base]["seeds"]), *(word for m in metrics for word in (_mean(whole[base], m), "", ""))])
        for name in [name for name in varied if name.partition(",")[0] == base]:
            cells, p = _variation(varied[name], whole.get(base), metrics)
            tested += [(len(rows), metric, value) for metric, value in p.items()]
            rows.append([name, *cells])
    corrected = _by_family([metric for _, metric, _ in tested], [p for *_, p in tested])
    for (row, metric, raw), holm in zip(tested, corrected, strict=True):
        rows[row][4 + 3 * metrics.index(metric)] = f"{raw:.3g} ({holm:.3g})"
    told = "One option differs from the row of the method's name; differences and tests are against it, paired by seed."
    return markdown(rows, left=1) + f"\n{told} {OVER_SEEDS} {TESTED}\n\n{made_by(results.finished(varied), study)}"


def _variation(record: Record, base: Record | None, metrics: Sequence[str]) -> tuple[list[str], dict[str, float]]:
    """Cells of a variation, and the p-value of each metric's difference from its base."""
    if "failed" in record:
        return [record["failed"], *[""] * 3 * len(metrics)], {}
    differences = {metric: _against(record, base, metric) for metric in metrics}
    told = [(_mean(record, metric), signed(d.tolist()) if len(d) else "", "") for metric, d in differences.items()]
    p = {metric: over_seeds.sign_flip(d) for metric, d in differences.items() if len(d) > 1}
    return [str(record["seeds"]), *(word for words in told for word in words)], p


def _ablated(held: Held) -> list[str]:
    """The metrics that variations are judged by."""
    scene = scene_type(next(iter(held.values()))["scene"])
    return list(dict.fromkeys((*scene.main_metrics, scene.coverage)))


def _mean(record: Record, metric: str) -> str:
    return number(record["metrics"][metric]["per_seed"], spread=True) if metric in record["metrics"] else ""


def _against(record: Record, base: Record | None, metric: str) -> np.ndarray:
    if base is None or not {metric} <= set(record["metrics"]) & set(base["metrics"]):
        return np.array([])
    return over_seeds.paired(results.metric(record, "prior", metric), results.metric(base, "prior", metric))


def _plain(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float | int) else ""


def _sizes(records: Iterable[Record]) -> str:
    held = list(records)
    told = {"seeds": "seeds", "update": "updates", "episodes": "test episodes"}
    return ", ".join(f"{_span(record[key] for record in held)} {what}" for key, what in told.items())


def _span(values: Iterable[int]) -> str:
    ordered = sorted(set(values))
    return str(ordered[0]) if len(ordered) == 1 else f"{ordered[0]} to {ordered[-1]}"


def made_by(shown: Held, folder: str) -> str:
    """The commands that make the rows of a table, with their commits; a warning where rows are of different code.

    Args:
        shown: the results in the table.
        folder: the name of their folder.
    """
    groups: dict[tuple[str, str, str, tuple[str, ...]], list[str]] = defaultdict(list)
    for name, record in shown.items():
        alone = "" if "study" in record else name  # `train` trains one method at a time
        groups[alone, record["scene"], str(record["seeds"]), own_options(name, record)].append(name)
    told = "Made by " + " and ".join(_command(*of, names, folder) for of, names in groups.items()) + "."
    if any(options for *_, options in groups):
        told += " What follows the number of seeds differs from the committed settings."
    commits = {of: [name for name in shown if _commit(shown[name]) == of] for of in dict.fromkeys(map(_commit, shown.values()))}
    told += " Commit " + "; ".join(f"{of} ({', '.join(names)})" if len(commits) > 1 else of for of, names in commits.items()) + "."
    if trained := {name: by for name, record in shown.items() if (by := _trained_at(record))}:
        told += " Trained at " + "; ".join(f"{', '.join(by)} ({name})" for name, by in trained.items()) + "."
    if len({record.get("measured_by") for record in shown.values()}) > 1:
        told += " **Rows were measured by different code**: the study measures again those that it finds finished."
    place = f"results/{folder}" if all("study" in record for record in shown.values()) else "DIR"
    return told + f" Tables and figures again, from the JSON files of this folder: `python -m rtc_mjx.report {place}`.\n"


def _command(alone: str, scene: str, seeds: str, options: tuple[str, ...], names: Sequence[str], folder: str) -> str:
    methods = ",".join(dict.fromkeys(name.partition(",")[0] for name in names))
    if alone:
        return f"`{shlex.join(['python', '-m', 'rtc_mjx.train', '--scene', scene, '--method', methods, '--seeds', seeds, *options])}`"
    varied = ["--ablations"] if any("," in name for name in names) else []
    named = ["--name", folder] if folder != scene else []
    words = ["--scene", scene, "--methods", methods, "--seeds", seeds, *varied, *named, *options, "--results", "results"]
    return f"`python -m rtc_mjx.study {shlex.join(words)}`"


def own_options(name: str, record: Record) -> tuple[str, ...]:
    """Options of a result without that of its variation; of a result of an earlier version, by what is committed now."""
    options = list(record["options"] if "options" in record else results.options(record["config"]))
    varied = f"--{name.partition(',')[2].partition('=')[0]}"
    if varied in options:
        place = options.index(varied)
        options = options[:place] + options[place + 2 :]
    return tuple(options)


def _commit(record: Record) -> str:
    return str(record["commit"] or "unknown")


def _trained_at(record: Record) -> list[str]:
    """The commits that trained a result, where they are not the one that measured it."""
    commits = list(dict.fromkeys(str(made["commit"] or "unknown") for made in record.get("trained_by", [])))
    return [] if commits == [_commit(record)] else commits
