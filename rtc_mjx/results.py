"""Results of a scene as files: a JSON file a training, of which every table and figure is made again without the runs.

`<name>.json` is evaluation.json with the settings, the command's options, the learning curves and, where there is one, type_shift.json.
`<name>.failed.json` says that a training came to nothing, and why; it stands for the training until there is a result.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rtc_mjx import config as settings
from rtc_mjx.errors import DivergedError, RunError, UsageError
from rtc_mjx.files import write_whole
from rtc_mjx.methods import METHODS
from rtc_mjx.over_seeds import Seeds
from rtc_mjx.runs import Run

Record = Mapping[str, Any]
EVALUATION = frozenset(("metrics", "types", "reference", "update", "seeds", "episodes", "asked", "commit"))
LOSSES = ("reconstruction", "cloning", "adversarial", "type_kl", "accuracy_expert", "accuracy_policy")  # curves beside the main metrics
FAILED = ".failed.json"
OF_A_RUN = ("config.json", "evaluation.json", "type_shift.json")  # beside results they are not taken for any
DIGITS = 5  # of a learning curve


def evaluation(run: Run) -> dict[str, Any]:
    """The run's evaluation.json.

    Raises:
        UsageError: it has not been evaluated.
    """
    file = run.folder / "evaluation.json"
    again = f"make it {{}}with: python -m rtc_mjx.evaluate --run {run.folder}"
    if not file.is_file():
        raise UsageError(f"{run.folder} has no evaluation.json; {again.format('')}")
    held = _parsed(file)
    if not isinstance(held, dict) or not set(held) >= EVALUATION:
        raise UsageError(f"{file} is of another version; {again.format('again ')}")
    return held


def analysis(run: Run) -> dict[str, Any]:
    """The run's type_shift.json; empty where there is none."""
    file = run.folder / "type_shift.json"
    held = _parsed(file) if file.is_file() else {}
    if not isinstance(held, dict):
        raise UsageError(f"{file} is damaged: an object is needed")
    return held


def of_run(run: Run, study: str = "") -> dict[str, Any]:
    """All that tables and figures need of a run, and what is needed to make it again; `study`: which made it."""
    shift, table = analysis(run), settings.to_dict(run.config)
    return {
        **evaluation(run),
        **({"type_shift": shift} if shift else {}),
        **({"study": study} if study else {}),
        "trained_by": run.trained_by(),
        "config": table,
        "options": options(table),
        "curves": curves(run),
    }


def curves(run: Run) -> dict[str, dict[str, Any]]:
    """Main metrics and losses by name: the `updates`, and of each the numbers `per_seed`.

    Raises:
        UsageError: metrics.jsonl is damaged.
    """
    held, out = run.metrics(), {}
    for name in (*run.config.scene.main_metrics, *LOSSES):
        if lines := [line for line in held if name in line]:
            try:
                values = [[float(f"{x:.{DIGITS}g}") for x in line[name]] for line in lines]
            except (TypeError, ValueError) as error:
                raise UsageError(f"{run.metrics_file} is damaged: '{name}' of some line is not a list of numbers ({error})") from error
            out[name] = {"updates": [line["update"] for line in lines], "per_seed": values}
    return out


def options(table: Mapping[str, Any]) -> list[str]:
    """What differs from the committed settings in the settings of a result, but for the number of seeds, as on the command line."""
    held = settings.flat(table)
    usual = settings.flat(settings.to_dict(settings.defaults(table["scene"]["name"], table["method"])))
    out: list[str] = []
    for name, value in held.items():
        if value == usual.get(name) or name in {"seeds", "run", "resume", *settings.unread(table["method"])}:
            continue
        *parents, last = name.replace("_", "-").split(".")
        if isinstance(value, bool):
            out.append("--" + ".".join([*parents, last if value else f"no-{last}"]))
        else:
            out += ["--" + ".".join([*parents, last]), str(value)]
    return out


def write(folder: Path, name: str, record: Record) -> None:
    """Writes a result; it takes the place of one before, and of a failure."""
    write_whole(folder / f"{name}.json", dumped(record))
    (folder / f"{name}{FAILED}").unlink(missing_ok=True)


def write_failure(folder: Path, name: str, scene: str, error: RunError) -> None:
    """Writes that a training came to nothing. A result before it stays, but is not shown."""
    what = "diverged" if isinstance(error, DivergedError) else "failed"
    write_whole(folder / f"{name}{FAILED}", dumped({"scene": scene, "method": name.split(",")[0], "failed": f"{what}: {error}"}))


def read(folder: Path) -> dict[str, Record]:
    """All results in a folder by name, methods first, as METHODS lists them; then their variations.

    Raises:
        UsageError: a file is damaged or of another version, or they are of several scenes.
    """
    files = [file for file in sorted(folder.glob("*.json")) if file.name not in OF_A_RUN]
    held = {file.name.removesuffix(".json"): record for file in files if _is_result(record := _parsed(file), file)}
    failed = {name.removesuffix(".failed"): record for name, record in held.items() if "failed" in record}
    records = {name: record for name, record in held.items() if "failed" not in record} | failed
    scenes = sorted({record["scene"] for record in records.values()})
    if len(scenes) > 1:
        raise UsageError(f"{folder} holds results of several scenes ({', '.join(scenes)}); those of one are needed")
    return {name: records[name] for name in sorted(records, key=_place)}


def _is_result(record: Any, file: Path) -> bool:
    """Whether it is one, and not a JSON file of something else.

    Raises:
        UsageError: it is one, but cannot be read as one.
    """
    if not (isinstance(record, dict) and {"scene", "method"} <= set(record)):
        return False
    if "failed" in record:
        return True
    if absent := sorted((EVALUATION | {"config", "curves"}) - set(record)):
        raise UsageError(f"{file} lacks {', '.join(absent)}: it is damaged or of another version; make it again, or take it away")
    try:
        wrong = next(_wrong(record), None)
    except (AttributeError, KeyError, TypeError) as error:
        wrong = f"{type(error).__name__}: {error}"
    if wrong:
        raise UsageError(f"{file} is damaged: {wrong}; make it again, or take it away")
    return True


def _wrong(record: Record) -> Iterator[str]:
    """What is not as it should be in a result that has all its parts."""
    count, table = record["seeds"], record["config"]
    if not isinstance(count, int) or count < 1:
        yield f"'seeds' is {count!r}, a number of seeds is needed"
    if absent := {"scene", "method", "first_seed", "seeds", "updates"} - set(table):
        yield f"'config' lacks {', '.join(sorted(absent))}"
    if "name" not in table["scene"]:
        yield "'config' lacks the scene's name"
    if "expert" not in record["reference"]:
        yield "'reference' lacks expert"
    for source, metrics in {"metrics": record["metrics"], **record["types"]}.items():
        for name, held in metrics.items():
            values = held["per_seed"]
            if len(values) != count or not all(isinstance(x, float | int) for x in (*values, held["mean"])):
                yield f"{name} ({source}) is not {count} numbers"


def _place(name: str) -> tuple[int, int, str, float, str]:
    """Where a result stands among others: its method's place; a variation by option, then by value."""
    method, _, varied = name.partition(",")
    option, _, value = varied.partition("=")
    known = list(METHODS).index(method) if method in METHODS else len(METHODS)
    return bool(varied), known, option, float(value) if re.fullmatch(r"[-+.e\d]+", value) else 0.0, name


def finished(records: Mapping[str, Record]) -> dict[str, Record]:
    """Those that did not fail."""
    return {name: record for name, record in records.items() if "failed" not in record}


def methods(records: Mapping[str, Record]) -> dict[str, Record]:
    """Those of whole methods, without variations."""
    return {name: record for name, record in records.items() if "," not in name}


def seeds(record: Record, values: Sequence[float]) -> Seeds:
    """A number of each seed, by the seed's own number."""
    return dict(enumerate(values, record["config"]["first_seed"]))


def metric(record: Record, source: str, name: str) -> Seeds:
    """A metric of each seed under a source of types."""
    return seeds(record, record["types"][source][name]["per_seed"])


def comparable(one: Record, other: Record) -> bool:
    """Whether two results were measured in the same test episodes: of recordings, a method may leave some out."""
    return bool(one.get("recordings") == other.get("recordings"))


def markdown(rows: Sequence[Sequence[str]], left: int) -> str:
    """A Markdown table of rows, the first of which is its head; `left`: how many columns are words, those after them are numbers."""
    head, *others = rows
    rule = ["---" if column < left else "---:" for column in range(len(head))]
    return "".join("| " + " | ".join(word.replace("|", "\\|") for word in row) + " |\n" for row in (head, rule, *others))


def dumped(record: Record) -> str:
    """As JSON, an indented line a value; lists of numbers on one line."""
    text = json.dumps(record, indent=1) + "\n"
    return re.sub(r"\[[-+.\deE,\s]+\]", lambda found: " ".join(found[0].split()).replace("[ ", "[").replace(" ]", "]"), text)


def _parsed(file: Path) -> Any:
    try:
        return json.loads(file.read_text())
    except ValueError as error:
        raise UsageError(f"{file} is damaged: {error}") from error
