"""Recorded scenes by the measures of the Waymo Open Sim Agents Challenge (2025): log replay, the ceiling, and a submission beside it.

Examples:
  python -m rtc_mjx.challenge scene.tfrecord                                  what log replay scores
  python -m rtc_mjx.challenge 'womd/*' --submission rollouts.binproto         a submission beside it
  python -m rtc_mjx.challenge 'womd/*' --submission 'shards/*' --json it.json    all figures of each scene as well

Everybody who is there at 1 s is simulated for 8 s; the self-driving car and the tracks to predict are scored. Submissions are
files of SimAgentsChallengeSubmission or ScenarioRollouts messages; scenes are matched by their scenario's id.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool
from rich.table import Table

from rtc_mjx import cli
from rtc_mjx.errors import RunError, UsageError
from rtc_mjx.files import write_whole
from rtc_mjx.logs import read
from rtc_mjx.logs.recording import Recording
from rtc_mjx.provenance import made_by
from rtc_mjx.sim_agents import ESTIMATES, Task, of_recording, places, realism, rollouts
from rtc_mjx.sim_agents.recorded import NOW
from rtc_mjx.sim_agents.score import INDICATORS
from rtc_mjx.sim_agents.submission import Place

ROLLOUTS = 32  # of each scene that the challenge asks for
META = "realism_meta_metric"
SUMS = (META, "kinematic", "interactive", "map_based", "average_displacement_error", "min_average_displacement_error")
ORDER = (*(f"{name}_likelihood" for name in ESTIMATES), *SUMS, *(f"simulated_{name}_rate" for name in INDICATORS))
Figures = dict[str, float | None]

compiled = jax.jit(realism)


@dataclass(frozen=True)
class Scored:
    """One scene.

    Attributes:
        name: the scenario's id.
        agents: how many are simulated.
        judged: how many of them are scored.
        notes: what was left out or guessed of the recording, in words, and how often.
        log_replay: the figures of the log itself, as of 32 rollouts.
        submission: those of a submission.
        count: the submission's rollouts.
    """

    name: str
    agents: int
    judged: int
    notes: dict[str, int]
    log_replay: Figures
    submission: Figures | None = None
    count: int = 0

    def lines(self) -> list[str]:
        """For people to read."""
        told = f"{self.name}: {self.agents} agents, {self.judged} scored; realism {_shown(self.log_replay[META])} by log replay"
        if self.submission is not None:
            told += f", {_shown(self.submission[META])} by the submission ({self.count} rollouts)"
        return [told, *(f"  {count:,} {what}" for what, count in self.notes.items())]


def figures(task: Task, simulated: Array, present: Bool[Array, "agents future"] | None = None) -> Figures:
    """All figures of a scene; None where nothing could be scored."""
    found = jax.device_get(compiled(task.log, simulated, task.scored, task.edges, task.lines, present))
    return {name: float(found[name]) if np.isfinite(found[name]) else None for name in ORDER}


def scored(recording: Recording, place: Place | None) -> Scored:
    """What log replay scores in a recording, and a submission if it has rollouts of it.

    Raises:
        UsageError: the recording cannot be scored, or the rollouts are not of its agents.
    """
    task = of_recording(recording)
    there = task.log.valid[:, NOW + 1 :]  # the log has its agents when it has them, while a submission always has all
    simulated = task.simulated(rollouts(place)) if place else None
    replay = figures(task, jnp.tile(task.replay(), (ROLLOUTS, 1, 1, 1)), there)
    scene = Scored(task.name, len(task.ids), int(jnp.sum(task.scored >= 0)), task.notes, replay)
    return scene if simulated is None else replace(scene, submission=figures(task, simulated), count=len(simulated))


def all_scored(paths: Sequence[str], submitted: dict[str, Place] | None, bad: list[UsageError]) -> Iterator[Scored]:
    """The scenes of all files that can be scored, one after the other; with a submission, those it has.

    Args:
        paths: files, folders or globs.
        submitted: where rollouts are; None without a submission.
        bad: is given what could not be scored.
    """
    for file in read.recorded(paths):
        try:
            for recording in read.recordings(file):
                place = (submitted or {}).get(recording.scenario)
                if submitted is None or place is not None:
                    try:
                        yield scored(recording, place)
                    except UsageError as error:
                        bad.append(error)
        except UsageError as error:
            bad.append(error)


def means(all_figures: Sequence[Figures]) -> Figures:
    """Over the scenes in which each could be scored."""
    known = {name: [value for found in all_figures if (value := found[name]) is not None] for name in ORDER}
    return {name: float(np.mean(values)) if values else None for name, values in known.items()}


def table(columns: dict[str, Figures], count: int) -> Table:
    """The figures of log replay and of a submission, side by side."""
    title = f"Sim Agents, {'one scene' if count == 1 else f'mean of {count:,} scenes'}"
    out = Table("figure", "weight", *(name.replace("_", " ") for name in columns), title=title, title_justify="left")
    for column in out.columns[1:]:
        column.justify = "right"
    for name in ORDER:
        weight = ESTIMATES.get(name.removesuffix("_likelihood"))
        told = (_shown(held[name]) for held in columns.values())
        out.add_row(name.replace("_", " "), f"{weight.weight:.2f}" if weight else "", *told)
    return out


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def main(argv: Sequence[str] | None = None) -> None:
    """Scores all recordings.

    Raises:
        UsageError: wrong options, no such file, or nothing can be scored.
        RunError: some cannot be scored.
    """
    asked = _parser().parse_args(argv)
    if asked.json and not asked.json.parent.is_dir():
        raise UsageError(f"--json {asked.json}: there is no folder {asked.json.parent}")
    submitted = places(asked.submission) if asked.submission else None
    done, bad = list[Scored](), list[UsageError]()
    for scene in all_scored(asked.paths, submitted, bad):
        print("\n".join(scene.lines()), flush=True)
        done.append(scene)
    _refuse_nothing(len(done), bad, submitted, asked.paths)
    columns = {"log_replay": means([scene.log_replay for scene in done])}
    if submitted is not None:
        columns["submission"] = means([scene.submission for scene in done if scene.submission is not None])
    cli.console().print(table(columns, len(done)))
    if asked.json:
        told = {"mean": columns, "scenes": [asdict(scene) for scene in done], **made_by()}
        write_whole(asked.json, json.dumps(told, indent=1) + "\n")
    _finish({scene.name for scene in done}, bad, submitted)


def _refuse_nothing(count: int, bad: Sequence[UsageError], submitted: dict[str, Place] | None, paths: Sequence[str]) -> None:
    """Where no scene was scored.

    Raises:
        UsageError: always then: why the only file was not, or what was looked for.
    """
    if count:
        return
    if len(bad) == 1:
        raise bad[0]
    _tell(bad)
    if submitted is not None and not bad:
        some = ", ".join(list(submitted)[:3]) + (" and others" if len(submitted) > 3 else "")
        raise UsageError(f"the submission has rollouts of {some}; none of the recordings is one of these")
    raise UsageError(f"{', '.join(paths)}: no recording is there that can be scored")


def _finish(names: set[str], bad: Sequence[UsageError], submitted: dict[str, Place] | None) -> None:
    """What else has to be said.

    Raises:
        RunError: some recordings could not be scored, so that the means are not of all.
    """
    left = len(set(submitted or ()) - names)
    if left:
        sys.stderr.write(f"{left} of {len(submitted or ())} scenarios of the submission have no recording here and were not scored\n")
    _tell(bad)
    if bad:
        raise RunError(f"{len(bad)} could not be scored and {'is' if len(bad) == 1 else 'are'} not in the means")


def _tell(bad: Sequence[UsageError]) -> None:
    for error in bad:
        sys.stderr.write(f"{error}\n")


def _parser() -> cli.Parser:
    parser = cli.Parser(prog="python -m rtc_mjx.challenge", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", metavar="RECORDING", help="files, folders or globs of recorded scenes")
    parser.add_argument("--submission", nargs="+", metavar="FILE", help="files, folders or globs of a submission's binary protos")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures of every scene")
    return parser


if __name__ == "__main__":
    cli.run(main)
