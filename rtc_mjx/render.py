"""Videos of a trained agent: rollouts under different types of the same episodes, with the expert's own path beside them.

    run -> rollouts of a few test episodes -> poses of the agent's body -> a world with ghosts and trails -> pictures -> H.264

`python -m rtc_mjx.render --run DIR --out FILE.mp4`. Coloured: the agents, one colour a type; white: the experts in this episode.
"""

import argparse
import itertools
import logging
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import jax
import mujoco
import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.progress import Progress

from rtc_mjx import cache, cli
from rtc_mjx.camera import Picture, camera
from rtc_mjx.errors import UsageError
from rtc_mjx.physics import World, place_surroundings
from rtc_mjx.runs import Run
from rtc_mjx.scenes import Scene
from rtc_mjx.trained import rollouts
from rtc_mjx.trajectory import Demonstration, Episode, Trajectory

PALETTE = ((0.93, 0.55, 0.15), (0.26, 0.62, 0.85), (0.62, 0.43, 0.80), (0.90, 0.76, 0.20), (0.42, 0.75, 0.42), (0.88, 0.45, 0.60))
EXPERT = (0.96, 0.96, 0.96)
EVERY = 3  # control steps between two marks of a trail
AWAY = -50.0  # m, below the ground: where marks wait for their time
HOLD = 10  # frames for which the end of an episode stays


def stage(scene: Scene, episode: Episode, actors: int, marks: int, size: tuple[int, int]) -> mujoco.MjModel:
    """The dressed world with marks for trails, and ghosts of the agents for each actor but the first unless shown side by side."""
    spec = scene.world.spec.copy()
    spec.visual.global_.offheight, spec.visual.global_.offwidth = size  # of what OpenGL draws into
    scene.dress(spec, episode)
    originals = [spec.body(name) for name in scene.agent_bodies]
    for geom in [g for body in originals for g in body.geoms if not scene.side_by_side or g.name.endswith("/body")]:
        geom.material, geom.rgba = "", [*EXPERT, 1]
    for actor, (index, original) in itertools.product(range(actors), enumerate(originals)):
        paint = [*colour(actor, index, scene.agents), 1]
        if actor and not scene.side_by_side:
            ghost = spec.worldbody.add_body(name=f"ghost{actor}_{index}", mocap=True)
            for g in original.geoms:
                ghost.add_geom(type=g.type, size=g.size, pos=g.pos, quat=g.quat, group=g.group, rgba=paint, contype=0, conaffinity=0)
        for mark in range(marks):
            dot = spec.worldbody.add_body(name=mark_name(actor, index, mark), mocap=True, pos=[0, 0, AWAY])
            dot.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[scene.mark_size * (1.0 if actor else 0.7)] * 3, rgba=paint,
                contype=0, conaffinity=0,
            )  # fmt: skip
    return spec.compile()


def mark_name(actor: int, agent: int, mark: int) -> str:
    """The body of one mark of an agent's trail."""
    return f"mark{actor}_{agent}_{mark}"


def colour(actor: int, agent: int = 0, agents: int = 1) -> tuple[float, float, float]:
    """White for experts (actor 0), one of the palette for each type: every agent of every other actor has one of its own."""
    return PALETTE[((actor - 1) * agents + agent) % len(PALETTE)] if actor else EXPERT


def poses(world: World, body: str, qpos: np.ndarray) -> tuple[Float[np.ndarray, "times 3"], Float[np.ndarray, "times 4"]]:
    """Position and orientation of a body along a trajectory."""
    data, index = mujoco.MjData(world.mj), world.body(body)
    places, turns = [], []
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_kinematics(world.mj, data)
        places.append(data.xpos[index].copy())
        turns.append(data.xquat[index].copy())
    return np.array(places), np.array(turns)


def pictures(run: Run, shown: Demonstration, tracks: Trajectory, camera_name: str, size: tuple[int, int]) -> Iterator[Picture]:
    """Every picture of the video, episode after episode; where a scene is shown side by side, the expert first, then type by type."""
    scene = run.config.scene
    actors, marks = tracks.actions.shape[1] + 1, scene.steps // EVERY + 1
    for index in range(tracks.actions.shape[0]):
        episode = jax.tree.map(lambda x, i=index: np.asarray(x[i]), shown.episode)
        driven = [np.asarray(shown.trajectory.states.qpos[index]), *np.asarray(tracks.states.qpos[index])]
        paths = [[poses(scene.world, body, qpos) for body in scene.agent_bodies] for qpos in driven]
        model = stage(scene, episode, 2 if scene.side_by_side else actors, marks, size)
        data, take = mujoco.MjData(model), camera(model, camera_name, *size)
        for time in range(scene.steps + 1):
            scene.paint(model, episode, time)
            around = episode.surroundings.pose[time]
            if scene.side_by_side:
                shots = []
                for actor in range(actors):
                    paint_agents(model, scene, marks, actor)
                    _place(model, data, driven[actor][time], around, [paths[0], paths[actor]], time, marks, ghosts=False)
                    shots.append(take(data))
                picture = np.concatenate(shots, axis=1)
            else:
                _place(model, data, driven[0][time], around, paths, time, marks, ghosts=True)
                picture = take(data)
            for _ in range(HOLD if time == scene.steps else 1):
                yield picture
        take.close()


def paint_agents(model: mujoco.MjModel, scene: Scene, marks: int, actor: int) -> None:
    """Gives the body of each agent and its own trail their colour of an actor."""
    for index, body in enumerate(scene.agent_bodies):
        paint = colour(actor, index, scene.agents)
        first, count = model.body(body).geomadr[0], model.body(body).geomnum[0]
        for geom in range(first, first + count):
            if model.geom(geom).name.endswith("/body"):
                model.geom_rgba[geom, :3] = paint
        for mark in range(marks):
            model.geom_rgba[model.body(mark_name(1, index, mark)).geomadr[0], :3] = paint


def _place(
    model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray, around: np.ndarray,
    paths: Sequence[Sequence[tuple[np.ndarray, np.ndarray]]], time: int, marks: int, ghosts: bool,
) -> None:  # fmt: skip
    """Puts everything where it is at a time; `paths` are those of each agent of each actor."""
    data.qpos[:] = qpos
    place_surroundings(data, around)
    index = len(around)
    for actor, (places, turns) in ((actor, path) for actor, agents in enumerate(paths) for path in agents):
        if actor and ghosts:
            data.mocap_pos[index], data.mocap_quat[index] = places[time], turns[time]
            index += 1
        for mark in range(marks):
            data.mocap_pos[index] = places[mark * EVERY] if mark * EVERY < time else (0, 0, AWAY)
            index += 1
    mujoco.mj_forward(model, data)


def write(frames: Iterator[Picture], file: Path, size: tuple[int, int], rate: float, total: int) -> int:
    """Encodes pictures of a size (height, width) as H.264 in an mp4; returns how many."""
    part, count = file.with_name(f".{file.name}.part"), 0
    with av.open(str(part), "w", format="mp4") as out, Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("frames", total=total)
        stream = out.add_stream("libx264", rate=Fraction(rate).limit_denominator(1000))
        stream.pix_fmt, (stream.height, stream.width) = "yuv420p", size
        for picture in frames:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            count += 1
            progress.advance(task)
        out.mux(stream.encode())
    part.replace(file)
    return count


def main(argv: Sequence[str] | None = None) -> None:
    """Writes a video of a run."""
    parser = cli.Parser(prog="python -m rtc_mjx.render", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, metavar="DIR", help="the run directory; its last checkpoint acts")
    parser.add_argument("--out", type=Path, metavar="FILE.mp4", help="the video (default: media/<camera>.mp4 in the run)")
    parser.add_argument("--camera", default="top", metavar="NAME", help="a camera of the scene's MJCF file (default %(default)s)")
    parser.add_argument("--episodes", type=int, default=4, help="test episodes, one after another (default %(default)s)")
    parser.add_argument("--types", type=int, default=5, help="rollouts in each, every one with a type of its own (default %(default)s)")
    parser.add_argument("--seed", type=int, metavar="N", help="which of the run's seeds acts (default: its first)")
    parser.add_argument("--size", default="480x480", metavar="WxH", help="picture size, even numbers (default %(default)s)")
    options = parser.parse_args(argv)
    run = Run.open(options.run)
    out = options.out or run.folder / "media" / f"{options.camera}.mp4"
    size = _size(options.size)
    cli.check_out(out, ".mp4")
    cli.at_least(1, episodes=options.episodes, types=options.types)
    view = full_name(run.config.scene, options.camera)
    logging.basicConfig(format="%(message)s")
    cache.keep_compiled()
    shown, tracks = rollouts(run, options.episodes, options.types, options.seed)
    whole = (size[0], size[1] * (tracks.actions.shape[1] + 1)) if run.config.scene.side_by_side else size
    rate = 1 / (run.config.scene.substeps * run.config.scene.world.timestep)
    total = len(tracks.actions) * (run.config.scene.steps + HOLD)
    count = write(pictures(run, shown, tracks, view, size), out, whole, rate, total)
    cli.console().print(f"{out}: {count} frames of {len(tracks.actions)} episodes")


def full_name(scene: Scene, wanted: str) -> str:
    """The name of a camera; that of one of the agent's own may leave out the agent's prefix.

    Raises:
        UsageError: there is no such camera; the message lists those there are.
    """
    prefix = scene.agent_body.rpartition("/")[0]
    cameras = {c.name.removeprefix(f"{prefix}/") if prefix else c.name: c.name for c in scene.world.spec.cameras}
    if wanted not in cameras:
        raise UsageError(f"--camera {wanted}: no such camera; there are {', '.join(cameras)}")
    return cameras[wanted]


def _size(text: str) -> tuple[int, int]:
    """(height, width) of 'WxH'."""
    parts = text.split("x")
    if len(parts) != 2 or not all(p.isdecimal() and int(p) >= 16 and int(p) % 2 == 0 for p in parts):
        raise UsageError(f"--size {text}: width x height in even numbers from 16 is needed, such as 480x480")
    return int(parts[1]), int(parts[0])


if __name__ == "__main__":
    cli.run(main)
