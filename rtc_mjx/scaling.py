"""How a training's speed grows with seeds, minibatch and devices: the rows of `python -m rtc_mjx.benchmark --scaling`.

Each number of devices has a process of its own. On a CPU the devices are simulated: they share its cores, so what their rows tell is what
sharing out costs, and only up to the number of cores what it gains. On accelerators they are real.
"""

import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from rich.table import Table

from rtc_mjx import config, dataset, sharding
from rtc_mjx.errors import RunError
from rtc_mjx.learner import Learner
from rtc_mjx.scenes import Scene
from rtc_mjx.sharding import BATCH, SEED, Grid
from rtc_mjx.updates import compiled_chunk, start_all

METHOD = "rtc_c"
UPDATES = 4  # of a timed sample
DEVICES = (1, 2, 4)
EXPERTS = 256  # demonstrations
LIMIT_S = 1800  # of one process


@dataclass(frozen=True)
class Case:
    """A training whose speed is measured.

    Attributes:
        what: the curve that it is a point of.
        devices: it runs on; 0 for the one device that needs no mesh.
        seeds: trained at once.
        batch: episodes of a minibatch.
        steps: control steps of an episode; the scene's own if not given.
        road_users: of driving; the scene's own if not given.
    """

    what: str
    devices: int
    seeds: int
    batch: int
    steps: int | None = None
    road_users: int | None = None

    def on(self, scene: Scene) -> Scene:
        """The scene as the case has it."""
        changes = {"steps": self.steps, "road_users": self.road_users}
        return dataclasses.replace(scene, **{name: value for name, value in changes.items() if value is not None})


def cases(scene: Scene, counts: Sequence[int] = DEVICES) -> list[Case]:
    """All points of all curves."""
    held = [Case("a mesh of one device", n, 1, 64) for n in (0, 1)]
    held += [Case("seeds", 0, n, 64) for n in (1, 2, 4, 8)]
    held += [Case("minibatch", 0, 1, n) for n in (16, 64, 256)]
    held += [Case("horizon", 0, 1, 64, steps=n) for n in (scene.steps // 2, scene.steps, 2 * scene.steps)]
    if hasattr(scene, "road_users"):
        held += [Case("road users", 0, 1, 64, road_users=n) for n in (2, 4, 8)]
    held += [Case("strong, over seeds", n, max(counts), 64) for n in counts]
    held += [Case("strong, over the minibatch", n, 1, 64) for n in counts]
    held += [Case("weak, over seeds", n, n, 64) for n in counts]
    held += [Case("weak, over the minibatch", n, 1, 64 * n) for n in counts]
    return held


def measure(scene: str, rounds: int, watch: Callable[[Sequence[int]], Iterable[int]] = iter) -> dict[str, Any]:
    """All rows, each number of devices in a process of its own; `watch` goes through these numbers.

    Raises:
        RunError: such a process failed.
    """
    found: dict[str, Any] = {"update": [], "all_reduce": []}
    for count in watch(DEVICES):
        command = [sys.executable, "-m", "rtc_mjx.benchmark", "--scaling-on", str(count), "--rounds", str(rounds), "--scene", scene]
        environment = {**os.environ, "JAX_NUM_CPU_DEVICES": str(count)}
        try:
            done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=LIMIT_S)
        except subprocess.TimeoutExpired as error:
            raise RunError(f"{count} devices: not done within {LIMIT_S} s") from error
        if done.returncode:
            raise RunError(f"{count} devices: {(done.stderr.strip().splitlines() or ['the process failed'])[-1]}")
        for part, rows in json.loads(done.stdout.splitlines()[-1]).items():
            found[part] += rows
    return found


def measure_here(scene: str, devices: int, rounds: int) -> dict[str, Any]:
    """The rows of a number of devices, in this process: all are compiled, then timed in turn; medians."""
    settings = config.defaults(scene, METHOD)
    mine = [case for case in cases(settings.scene) if max(1, case.devices) == devices]
    running, rows = [], []
    for case in mine:
        expert = dataset.demonstrations(case.on(settings.scene), EXPERTS, dataset.TRAIN)
        told = dataclasses.replace(settings, scene=case.on(settings.scene), batch=case.batch)
        chosen = told.learner(dataset.statistics(told.scene, expert))
        grid = on(case, chosen)
        state, data = grid.by_seed(start_all(chosen, range(case.seeds))), grid.everywhere(dataset.without_truth(expert))
        begin = time.perf_counter()
        program = compiled_chunk(chosen, UPDATES, grid).lower(state, data).compile()
        rows.append({**dataclasses.asdict(case), "compile_s": time.perf_counter() - begin, "temp_mb": _temp_mb(program)})
        running.append((program, data, jax.block_until_ready(program(state, data)[0])))
    spent: list[list[float]] = [[] for _ in mine]
    for _ in range(rounds):
        for i, (program, data, state) in enumerate(running):
            begin = time.perf_counter()
            running[i] = (program, data, jax.block_until_ready(program(state, data)[0]))
            spent[i].append(time.perf_counter() - begin)
    for row, case, times in zip(rows, mine, spent, strict=True):
        row["updates_per_s"] = case.seeds * UPDATES / float(np.median(times))
    return {"update": rows, "all_reduce": [all_reduce(chosen, devices, rounds)] if devices > 1 else []}


def on(case: Case, learner: Learner) -> Grid:
    """The devices of a case."""
    if not case.devices:
        return sharding.ONE_DEVICE
    if case.devices == 1:
        return Grid(Mesh(np.array(jax.devices()[:1]).reshape(1, 1), (SEED, BATCH)))
    return sharding.grid(jax.devices(), case.seeds, [learner.size(b) for b in learner.method.branches], case.devices)


def all_reduce(learner: Learner, devices: int, rounds: int) -> dict[str, Any]:
    """The sum over devices of one seed's gradient, by itself: its bytes, and its time."""
    vector = ravel_pytree(jax.tree.map(lambda x: x[0], start_all(learner, range(1)).networks))[0]
    mesh = Mesh(np.array(jax.devices()[:devices]), (BATCH,))
    summed = jax.jit(jax.shard_map(lambda x: jax.lax.psum(x, BATCH), mesh=mesh, in_specs=P(), out_specs=P(), check_vma=False))
    jax.block_until_ready(summed(vector))
    times = []
    for _ in range(10 * rounds):
        begin = time.perf_counter()
        jax.block_until_ready(summed(vector))
        times.append(time.perf_counter() - begin)
    return {"devices": devices, "bytes": int(jnp.asarray(vector).nbytes), "ms": 1e3 * float(np.median(times))}


def _temp_mb(program: jax.stages.Compiled) -> float | None:
    analysis = program.memory_analysis()
    return analysis.temp_size_in_bytes / 1e6 if analysis else None


def table(found: dict[str, Any], scene: str) -> Table:
    """The rows for the terminal, each with its ratio to the first of its curve."""
    out = Table(title=f"Updates of {METHOD} on {scene}: of one seed, a second")
    for column in ("curve", "devices", "seeds", "minibatch", "steps", "users", "updates/s", "x first", "compile s", "temp MB"):
        out.add_column(column, justify="left" if column == "curve" else "right")
    for what in dict.fromkeys(row["what"] for row in found["update"]):
        rows = [row for row in found["update"] if row["what"] == what]
        for row in rows:
            speed, first = row["updates_per_s"], rows[0]["updates_per_s"]
            case = (what, row["devices"] or "1, no mesh", row["seeds"], row["batch"], row["steps"] or "", row["road_users"] or "")
            memory = f"{row['temp_mb']:.1f}" if row["temp_mb"] is not None else "-"
            measured = (f"{speed:.1f}", f"{speed / first:.2f}", f"{row['compile_s']:.1f}", memory)
            out.add_row(*map(str, case), *measured, end_section=row is rows[-1])
    return out
