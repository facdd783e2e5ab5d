"""Videos of a trained agent: rollouts under different types of the same episodes, with the expert's own path beside them.

    run -> rollouts of a few test episodes -> poses of the agent's body -> a world with ghosts and trails -> pictures -> H.264

`python -m rtc_mjx.render --run DIR --out FILE.mp4`. Coloured: the agent, one colour a type; white: the expert in this episode.
"""

import argparse
import logging
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import jax
import mujoco
import numpy as np
from jax import random
from jaxtyping import Float
from rich.console import Console
from rich.progress import Progress

from rtc_mjx import cache, cli, dataset
from rtc_mjx.agent_types import SOURCES
from rtc_mjx.camera import Picture, camera
from rtc_mjx.errors import UsageError
from rtc_mjx.keys import stream
from rtc_mjx.learner import start_shapes
from rtc_mjx.physics import World, place_surroundings
from rtc_mjx.runs import Run
from rtc_mjx.trajectory import Demonstration, Trajectory

PALETTE = ((0.93, 0.55, 0.15), (0.26, 0.62, 0.85), (0.62, 0.43, 0.80), (0.90, 0.76, 0.20), (0.42, 0.75, 0.42), (0.88, 0.45, 0.60))
EXPERT = (0.96, 0.96, 0.96)
EVERY = 3  # control steps between two marks of a trail
AWAY = -50.0  # m, below the ground: where marks wait for their time
HOLD = 10  # frames for which the end of an episode stays


def rollouts(run: Run, episodes: int, types: int, seed_index: int) -> tuple[Demonstration, Trajectory]:
    """Test demonstrations, and rollouts of the run's last checkpoint in each under `types` draws of its test types."""
    config = run.config
    learner = config.learner(dataset.statistics(config.scene, dataset.demonstrations(config.scene, config.experts.train, dataset.TRAIN)))
    test = dataset.demonstrations(config.scene, config.experts.test, dataset.TEST)
    shown = jax.tree.map(lambda x: x[:episodes], test)
    _, state, _ = run.restore(start_shapes(learner, config.all_seeds))
    agent = learner.agent(jax.tree.map(lambda x: x[seed_index], state.networks))

    def play(demonstration: Demonstration, key: jax.Array) -> Trajectory:
        draw, noise = random.split(key)
        g = SOURCES[learner.method.test_types](agent, demonstration, draw).agent_type
        return learner.play(agent, demonstration.episode, g, noise)

    keys = random.split(stream("evaluation", 0), (min(episodes, config.experts.test), types))
    inner = jax.vmap(play, in_axes=(None, 0))
    return shown, jax.device_get(jax.jit(jax.vmap(inner))(dataset.without_truth(shown), keys))


def stage(world: World, body: str, actors: int, marks: int, size: tuple[int, int]) -> mujoco.MjModel:
    """The world with a copy of the agent's body for each actor but the first, and marks for everyone's trail."""
    spec = world.spec.copy()
    spec.visual.global_.offheight, spec.visual.global_.offwidth = size  # of what OpenGL draws into
    original = spec.body(body)
    colours = [EXPERT, *(PALETTE[i % len(PALETTE)] for i in range(actors - 1))]
    for geom in original.geoms:
        geom.material, geom.rgba = "", [*colours[0], 1]
    for actor in range(actors):
        if actor:
            ghost = spec.worldbody.add_body(name=f"ghost{actor}", mocap=True)
            for g in original.geoms:
                ghost.add_geom(
                    type=g.type, size=g.size, pos=g.pos, quat=g.quat, group=g.group, rgba=[*colours[actor], 1], contype=0, conaffinity=0
                )
        for mark in range(marks):
            dot = spec.worldbody.add_body(name=f"mark{actor}_{mark}", mocap=True, pos=[0, 0, AWAY])
            radius = [0.018 if actor else 0.013] * 3
            dot.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=radius, rgba=[*colours[actor], 1], contype=0, conaffinity=0)
    return spec.compile()


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
    """Every picture of the video, episode after episode."""
    scene = run.config.scene
    world, body = scene.world, scene.agent_body
    actors, marks = tracks.actions.shape[1] + 1, scene.steps // EVERY + 1
    model = stage(world, body, actors, marks, size)
    data, take = mujoco.MjData(model), None
    for episode in range(tracks.actions.shape[0]):
        expert = shown.trajectory.states.qpos[episode]
        paths = [poses(world, body, q) for q in (expert, *tracks.states.qpos[episode])]
        around = shown.episode.surroundings.pose[episode]
        for time in range(scene.steps + 1):
            _place(model, data, np.asarray(expert[time]), np.asarray(around[time]), paths, time, marks)
            take = take or camera(model, camera_name, *size)
            picture = take(data)
            for _ in range(HOLD if time == scene.steps else 1):
                yield picture


def _place(
    model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray, around: np.ndarray, paths: Sequence[tuple[np.ndarray, np.ndarray]],
    time: int, marks: int,
) -> None:  # fmt: skip
    """Puts everything where it is at a time."""
    data.qpos[:] = qpos
    place_surroundings(data, around)
    index = len(around)
    for actor, (places, turns) in enumerate(paths):
        if actor:
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
    parser.add_argument("--seed", type=int, default=0, metavar="I", help="which of the run's seeds acts (default %(default)s)")
    parser.add_argument("--size", default="480x480", metavar="WxH", help="picture size, even numbers (default %(default)s)")
    options = parser.parse_args(argv)
    run = Run.open(options.run)
    out = options.out or run.folder / "media" / f"{options.camera}.mp4"
    size = _size(options.size)
    if out.suffix != ".mp4" or not out.absolute().parent.is_dir():
        raise UsageError(f"--out {out}: a file name that ends in .mp4, in a folder that exists, is needed")
    for name, least in (("episodes", 1), ("types", 1)):
        if getattr(options, name) < least:
            raise UsageError(f"--{name} {getattr(options, name)}: at least {least} is needed")
    if not 0 <= options.seed < run.config.seeds:
        raise UsageError(f"--seed {options.seed}: the run has seeds 0 to {run.config.seeds - 1}")
    cameras = [c.name for c in run.config.scene.world.spec.cameras]
    if options.camera not in cameras:
        raise UsageError(f"--camera {options.camera}: no such camera; there are {', '.join(cameras)}")
    logging.basicConfig(format="%(message)s")
    cache.keep_compiled()
    shown, tracks = rollouts(run, options.episodes, options.types, options.seed)
    rate = 1 / (run.config.scene.substeps * run.config.scene.world.timestep)
    total = len(tracks.actions) * (run.config.scene.steps + HOLD)
    count = write(pictures(run, shown, tracks, options.camera, size), out, size, rate, total)
    Console().print(f"{out}: {count} frames of {len(tracks.actions)} episodes")


def _size(text: str) -> tuple[int, int]:
    """(height, width) of 'WxH'."""
    parts = text.split("x")
    if len(parts) != 2 or not all(p.isdigit() and int(p) >= 16 and int(p) % 2 == 0 for p in parts):
        raise UsageError(f"--size {text}: width x height in even numbers from 16 is needed, such as 480x480")
    return int(parts[1]), int(parts[0])


if __name__ == "__main__":
    cli.run(main)
