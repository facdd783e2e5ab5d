"""Who goes where: experts and the agents of several runs in the same test episodes, beside each other in one picture.

`python -m rtc_mjx.populations RUN... --out FILE.png`. A column is a population, a row an episode, a line one of many that act in it, each
with a mind, or a type drawn from the prior, of its own. What all lines of a row share is luck; how they differ is what makes a population.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from rtc_mjx import cache, cli, dataset
from rtc_mjx.charts import save
from rtc_mjx.errors import UsageError
from rtc_mjx.figures import episode_of, paths
from rtc_mjx.render import poses
from rtc_mjx.runs import Run, by_method
from rtc_mjx.scenes import Scene
from rtc_mjx.trained import rollouts
from rtc_mjx.trajectory import Demonstration, Trajectory

SIDE = 2.5  # inches, of a cell
AHEAD = 0.15  # rad: who ends within this angle of where it headed at first went straight on
HARDLY = 0.1  # of the way of who goes furthest: too short to have a direction
LEFT, RIGHT, STRAIGHT = "tab:blue", "tab:orange", "0.35"


def experts(scene: Scene, shown: Demonstration, count: int) -> Trajectory:
    """What so many experts do in test episodes, leading axes (episodes, experts); the one who drove where nobody else can."""
    episodes = len(jax.tree.leaves(shown)[0])
    if scene.redrivable:
        return dataset.by_others(scene, episodes, dataset.TEST, count).trajectory
    return jax.tree.map(lambda x: np.asarray(x)[:, None], shown.trajectory)


def of_runs(runs: Sequence[Run], episodes: int, agents: int, seed: int | None = None) -> tuple[Scene, Demonstration, dict[str, Trajectory]]:
    """The scene, the test demonstrations, and by name what each population does in them, experts first: (episodes, agents, ...).

    Raises:
        UsageError: the runs are of different scenes, two are of one method, or one has no such seed.
    """
    named, scene = by_method(runs), runs[0].config.scene
    for run in runs:
        if run.config.scene != scene:
            raise UsageError(f"{run.folder}: its scene has other settings than that of {runs[0].folder}")
    held = {}
    for name, run in named.items():
        shown, held[name] = rollouts(run, episodes, agents, seed)
    return scene, shown, {"expert": experts(scene, shown, agents), **held}


def directions(scene: Scene, ways: Float[np.ndarray, "actors times coordinates"]) -> list[str]:
    """A colour for each way: blue for who ends left of where it headed at first, orange right, grey straight on, or hardly anywhere."""
    w, x, y, z = poses(scene.world, scene.agent_body, ways[0, :1])[1][0]
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    dx, dy = (ways[:, -1, :2] - ways[:, 0, :2]).T
    angle = np.angle(np.exp(1j * (np.arctan2(dy, dx) - heading)))
    far = np.hypot(dx, dy)
    straight = (np.abs(angle) < AHEAD) | (far < HARDLY * far.max())
    return [STRAIGHT if ahead else LEFT if a > 0 else RIGHT for ahead, a in zip(straight, angle, strict=True)]


def draw(scene: Scene, shown: Demonstration, held: Mapping[str, Trajectory]) -> Figure:
    """The picture; all cells of a row show the same part of the world."""
    episodes = len(jax.tree.leaves(shown)[0])
    canvas = Figure(figsize=(SIDE * len(held), SIDE * episodes), layout="constrained")
    axes = canvas.subplots(episodes, len(held), squeeze=False)
    for index, row in enumerate(axes):
        for cell, (name, tracks) in zip(row, held.items(), strict=True):
            mine = episode_of(tracks, index)
            colours = directions(scene, np.asarray(mine.states.qpos))
            paths(cell, scene, episode_of(shown.episode, index), mine, colours, name if index == 0 else "")
        ends = np.array([(*cell.get_xlim(), *cell.get_ylim()) for cell in row])
        (left, low), (right, high) = ends[:, ::2].min(axis=0), ends[:, 1::2].max(axis=0)
        for cell in row:
            cell.set(xlim=(left, right), ylim=(low, high))
    return canvas


def main(argv: Sequence[str] | None = None) -> None:
    """Draws the populations of runs."""
    parser = cli.Parser(prog="python -m rtc_mjx.populations", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run directories of one scene; the last checkpoint of each acts")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.png", help="the picture")
    parser.add_argument("--episodes", type=int, default=2, help="test episodes, a row each (default %(default)s)")
    parser.add_argument("--agents", type=int, default=24, help="lines in each cell (default %(default)s)")
    parser.add_argument("--seed", type=int, metavar="N", help="which of a run's seeds acts (default: the first of each)")
    options = parser.parse_args(argv)
    cli.check_out(options.out, ".png")
    cli.at_least(1, episodes=options.episodes, agents=options.agents)
    runs = [Run.open(folder) for folder in options.runs]
    cache.keep_compiled()
    save(draw(*of_runs(runs, options.episodes, options.agents, options.seed)), options.out)
    cli.console().print(f"{options.out}: {options.episodes} episodes, {', '.join(run.config.method for run in runs)} beside experts")


if __name__ == "__main__":
    cli.run(main)
