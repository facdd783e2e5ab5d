"""Physics, side by side in one process: MJX as it comes, ours plain, ours specialised, and hand-written equations; and whole updates.

Variants are timed in turn, round by round, so that a slow moment of the machine meets all of them; medians are reported. A
rollout starts from random states, with road users close enough that some worlds collide; the gradient is that of the last
positions with respect to all controls. An update is one of training: sampling, rollouts, losses, gradients, optimiser.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from mujoco import mjx
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from rtc_mjx import cache, cli, config, dataset, pile_up, scaling
from rtc_mjx.errors import UsageError
from rtc_mjx.physics import OneStep, PhysicsState, Surroundings, World, load, rest_state, rest_surroundings, simulate, specialised_step
from rtc_mjx.physics.car import WHEELBASE
from rtc_mjx.provenance import made_by
from rtc_mjx.updates import compiled_chunk, start_all

WORLDS: dict[str, Callable[[], World]] = {
    "point_mass": lambda: load("double_goal"),
    "car": lambda: load("driving", road_users=0),
    "car_8": lambda: load("driving", road_users=8),
}
VARIANTS = ("native", "plain", "specialised", "handwritten")
DIRECTIONS = ("forward", "gradient")
BATCHES = (16, 64, 256, 1024, 4096)
PARTS = ("physics", "pile_up", "update")
UPDATED = {"double_goal": (1, 8), "intersection": (1,)}  # scenes whose updates are timed, and for how many seeds
UPDATES = 10  # training updates of a timed sample
STEPS = 32  # physics steps of a rollout
SAMPLE_SECONDS = 0.05  # how long one timed sample lasts at least
MEMORY_LIMIT_MB = 6000.0  # rows that would need more are left out, and say so

Inputs = tuple[PhysicsState, Float[Array, "batch steps controls"], Surroundings]
Rollout = Callable[[PhysicsState, Array, Surroundings], Array]


@dataclass(frozen=True)
class Row:
    """One measurement; `steps_per_s` is None where it did not fit into memory."""

    world: str
    batch: int
    variant: str
    direction: str
    steps_per_s: float | None
    compile_s: float
    temp_mb: float


def random_inputs(world: World, batch: int, steps: int, seed: int = 0) -> Inputs:
    """Random states, controls and surroundings: cars at 3 to 9 m/s with road users 2 to 12 m away, all over the field."""
    random = np.random.default_rng(seed)
    nv, users = world.mj.nv, len(world.mocap_ids)
    qpos, qvel = 0.3 * random.standard_normal((batch, nv)), 0.3 * random.standard_normal((batch, nv))
    if nv == 4:
        heading, speed = random.uniform(-np.pi, np.pi, batch), random.uniform(3, 9, batch)
        qpos[:, 2], qvel[:, 0], qvel[:, 1] = heading, speed * np.cos(heading), speed * np.sin(heading)
    distance, bearing = random.uniform(2, 12, (batch, users)), random.uniform(-np.pi, np.pi, (batch, users))
    place = np.stack([distance * np.cos(bearing), distance * np.sin(bearing), random.uniform(-np.pi, np.pi, (batch, users))], axis=2)
    warm = rest_state(world).warmstart.size
    state = PhysicsState(*(jnp.asarray(x, jnp.float32) for x in (qpos, qvel, np.zeros((batch, warm)))))
    controls = jnp.asarray(random.uniform(-0.5, 0.5, (batch, steps, len(world.control_ids))), jnp.float32)
    size = jnp.broadcast_to(rest_surroundings(world).size, (batch, users, 2))
    return state, controls, Surroundings(jnp.asarray(place, jnp.float32), size)


def native_rollout(world: World) -> Rollout:
    """`mjx.step` as it comes, with `mjx.Data` carried, and iterations = 1: the only setting that reverse-differentiates."""
    model = mjx.put_model(world.mj, impl="jax")
    model = model.tree_replace({"opt.iterations": 1})
    template, heights = mjx.make_data(world.mj, impl="jax"), world.mj.body_pos[list(world.mocap_ids), 2]

    def rollout(state: PhysicsState, controls: Array, around: Surroundings) -> Array:
        x, y, heading = around.pose.T
        zero = jnp.zeros_like(x)
        data = template.replace(
            qpos=state.qpos,
            qvel=state.qvel,
            mocap_pos=jnp.stack([x, y, zero + heights], axis=1),
            mocap_quat=jnp.stack([jnp.cos(heading / 2), zero, zero, jnp.sin(heading / 2)], axis=1),
        )
        ids = np.array(world.control_ids, int)

        def body(data: mjx.Data, control: Array) -> tuple[mjx.Data, None]:
            return mjx.step(model, data.replace(ctrl=data.ctrl.at[ids].set(control))), None

        return lax.scan(body, data, controls)[0].qpos

    return rollout


def our_rollout(world: World, specialised: bool) -> Rollout:
    """Our step, plain or specialised."""
    one_step = specialised_step(world) if specialised else None
    return lambda state, controls, around: simulate(world, state, controls, around, one_step=one_step)[0].qpos


def by_hand(world: World) -> OneStep:
    """The same step by hand-written equations, without contacts: a damped point mass, or a kinematic bicycle about its middle."""
    h = world.timestep

    def point_mass(state: PhysicsState, force: Array, around: Surroundings) -> PhysicsState:
        velocity = (state.qvel + h * 6.0 * jnp.clip(force, -1, 1)) / (1 + 2.0 * h)
        return PhysicsState(state.qpos + h * velocity, velocity, state.warmstart)

    def bicycle(state: PhysicsState, control: Array, around: Surroundings) -> PhysicsState:
        heading, steer = state.qpos[2], jnp.clip(control[1], -0.6, 0.6)
        speed = jnp.cos(heading) * state.qvel[0] + jnp.sin(heading) * state.qvel[1]
        speed = jnp.maximum(0.0, speed + h * jnp.clip(control[0], -8.829, 4))
        course = heading + jnp.arctan(0.5 * jnp.tan(steer))
        qvel = jnp.stack([speed * jnp.cos(course), speed * jnp.sin(course), speed * jnp.tan(steer) / WHEELBASE, jnp.zeros(())])
        return PhysicsState((state.qpos + h * qvel).at[3].set(steer), qvel, state.warmstart)

    return point_mass if world.mj.nv == 2 else bicycle


def handwritten_rollout(world: World) -> Rollout | None:
    """The floor: hand-written equations in plain JAX; None where there are road users, whom they do not touch."""
    if world.users:
        return None
    one_step = by_hand(world)

    def rollout(state: PhysicsState, controls: Array, around: Surroundings) -> Array:
        return lax.scan(lambda s, control: (one_step(s, control, around), None), state, controls)[0].qpos

    return rollout


def rollouts(world: World) -> dict[str, Rollout]:
    """All variants of a world."""
    made = {
        "native": native_rollout(world),
        "plain": our_rollout(world, specialised=False),
        "specialised": our_rollout(world, specialised=True),
        "handwritten": handwritten_rollout(world),
    }
    return {name: rollout for name, rollout in made.items() if rollout is not None}


def program(rollout: Rollout, direction: str) -> Callable[..., Array]:
    """The batched function that is timed."""
    batched = jax.vmap(rollout)
    if direction == "forward":
        return batched
    return lambda state, controls, around: jax.grad(lambda u: jnp.sum(batched(state, u, around)))(controls)


def measure(world_name: str, world: World, batch: int, direction: str, rounds: int, variants: Sequence[str] = VARIANTS) -> list[Row]:
    """Compiles every variant, then times them in turn."""
    inputs = random_inputs(world, batch, STEPS)
    compiled, compile_s, temp_mb = {}, {}, {}
    for name, rollout in rollouts(world).items():
        if name not in variants:
            continue
        start = time.perf_counter()
        compiled[name] = jax.jit(program(rollout, direction)).lower(*inputs).compile()
        compile_s[name] = time.perf_counter() - start
        analysis = compiled[name].memory_analysis()
        temp_mb[name] = analysis.temp_size_in_bytes / 1e6 if analysis else float("nan")
    fits = [name for name in compiled if temp_mb[name] <= MEMORY_LIMIT_MB]
    calls = {name: max(1, int(SAMPLE_SECONDS / _seconds(compiled[name], inputs, 1))) for name in fits}
    times: dict[str, list[float]] = {name: [] for name in fits}
    for _ in range(rounds):
        for name in fits:
            times[name].append(_seconds(compiled[name], inputs, calls[name]))
    rate = {name: batch * STEPS / float(np.median(times[name])) for name in fits}
    return [Row(world_name, batch, name, direction, rate.get(name), compile_s[name], temp_mb[name]) for name in compiled]


def _seconds(function: Callable[..., Array], inputs: Inputs, calls: int) -> float:
    """Seconds a call, of several in a row after one that warms up: a single short rollout would measure its dispatch."""
    jax.block_until_ready(function(*inputs))
    start = time.perf_counter()
    for _ in range(calls):
        out = function(*inputs)
    jax.block_until_ready(out)
    return (time.perf_counter() - start) / calls


def updates(scene: str, method: str, rounds: int, seed_counts: Sequence[int]) -> list[dict[str, object]]:
    """Milliseconds an update of a method takes, on MJX and on hand-written equations, for numbers of seeds."""
    settings = config.defaults(scene, method)
    expert = dataset.demonstrations(settings.scene, 1024, dataset.TRAIN)
    learner, data = settings.learner(dataset.statistics(settings.scene, expert)), dataset.without_truth(expert)
    running = {}
    for physics, count in ((p, n) for p in ("mjx", "handwritten") for n in seed_counts):
        chosen = dataclasses.replace(learner, one_step=by_hand(settings.scene.world) if physics == "handwritten" else None)
        state = start_all(chosen, range(count))
        program = compiled_chunk(chosen, UPDATES).lower(state, data).compile()
        running[physics, count] = (program, program(state, data)[0])
    times: dict[tuple[str, int], list[float]] = {key: [] for key in running}
    for _ in range(rounds):
        for key, (program, state) in running.items():
            begin = time.perf_counter()
            running[key] = (program, jax.block_until_ready(program(state, data)[0]))
            times[key].append(time.perf_counter() - begin)
    return [
        {"scene": scene, "method": method, "physics": physics, "seeds": count, "ms": 1e3 * float(np.median(spent)) / UPDATES}
        for (physics, count), spent in times.items()
    ]


def updates_table(rows: Sequence[dict[str, object]]) -> Table:
    """Whole updates, with their ratio to the hand-written physics and to one seed."""
    ms = {(r["physics"], r["seeds"]): float(str(r["ms"])) for r in rows}
    out = Table(title=f"One update of {rows[0]['method']} on {rows[0]['scene']}")
    for column in ("physics", "seeds", "ms", "x handwritten", "x one seed"):
        out.add_column(column, justify="left" if column == "physics" else "right")
    for (physics, seeds), spent in ms.items():
        floor, one = ms["handwritten", seeds], ms[physics, 1]
        out.add_row(str(physics), str(seeds), f"{spent:.1f}", f"{spent / floor:.2f}", f"{spent / one:.2f}")
    return out


def first_result_seconds(world_name: str) -> float:
    """From calling for a specialised step to the first gradient of a batch of 64, in a process that finds a warm cache."""
    seconds = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(2):  # the first fills the cache
            command = [sys.executable, "-m", "rtc_mjx.benchmark", "--first-result", world_name]
            environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": folder, "XDG_CACHE_HOME": folder}  # compiled and folded programs
            done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
            seconds = float(done.stdout.split()[-1])
    return seconds


def _first_result(world_name: str) -> float:
    cache.keep_compiled()
    world = WORLDS[world_name]()
    inputs = random_inputs(world, 64, STEPS)
    start = time.perf_counter()
    jax.block_until_ready(jax.jit(program(our_rollout(world, specialised=True), "gradient"))(*inputs))
    return time.perf_counter() - start


def table(rows: Sequence[Row]) -> Table:
    """Rows with ratios to native, for the terminal."""
    native = {(r.world, r.batch, r.direction): r for r in rows if r.variant == "native"}
    out = Table(title=f"Physics steps a second (rollouts of {STEPS} steps)")
    for column in ("world", "batch", "direction", "variant", "steps/s", "x native", "compile s", "x native", "temp MB"):
        out.add_column(column, justify="left" if column in ("world", "direction", "variant") else "right")
    for row in rows:
        base = native.get((row.world, row.batch, row.direction))
        speed = f"{row.steps_per_s:,.0f}" if row.steps_per_s else "no memory"
        faster = f"{row.steps_per_s / base.steps_per_s:.1f}" if base and row.steps_per_s and base.steps_per_s else "-"
        compiles = f"{row.compile_s / base.compile_s:.2f}" if base else "-"
        cells = (row.world, row.batch, row.direction, row.variant, speed, faster, f"{row.compile_s:.1f}", compiles, f"{row.temp_mb:.1f}")
        out.add_row(*map(str, cells), end_section=row.variant == VARIANTS[-1] or (row.world, row.variant) == ("car_8", "specialised"))
    return out


def figure(rows: Sequence[Row], path: Path) -> None:
    """Throughput against batch size, one panel a world and direction."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    worlds = list(dict.fromkeys(r.world for r in rows))
    canvas, axes = pyplot.subplots(2, len(worlds), figsize=(3.6 * len(worlds), 5.6), sharex=True, squeeze=False)
    for (i, direction), (j, world) in ((a, b) for a in enumerate(DIRECTIONS) for b in enumerate(worlds)):
        for variant in VARIANTS:
            chosen = [r for r in rows if (r.world, r.direction, r.variant) == (world, direction, variant) and r.steps_per_s]
            if chosen:
                axes[i][j].loglog([r.batch for r in chosen], [r.steps_per_s for r in chosen], "o-", label=variant)
        axes[i][j].set_title(f"{world}, {direction}")
        axes[i][j].grid(alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel("physics steps / s")
    for axis in axes[-1]:
        axis.set_xlabel("batch")
    axes[0][0].legend(frameon=False)
    canvas.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    canvas.savefig(path, dpi=150)
    pyplot.close(canvas)


def arguments() -> argparse.ArgumentParser:
    """The command's options."""
    parser = cli.Parser(prog="python -m rtc_mjx.benchmark", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--quick", action="store_true", help="batch 64, three rounds, without the plain variant; under three minutes on two cores"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all rows as JSON")
    parser.add_argument("--figure", type=Path, metavar="FILE.png", help="draw throughput against batch size")
    parser.add_argument("--parts", metavar="LIST", help=f"comma-separated, of {','.join(PARTS)} (default all; with --quick not update)")
    parser.add_argument("--worlds", default=",".join(WORLDS), help="comma-separated, of %(default)s")
    parser.add_argument("--batches", default=",".join(map(str, BATCHES)), help="comma-separated batch sizes (default %(default)s)")
    parser.add_argument("--rounds", type=int, default=7, help="timed rounds, of which the median counts (default %(default)s)")
    parser.add_argument("--scaling", action="store_true", help="measure instead how updates scale with seeds, minibatch and devices")
    parser.add_argument("--scene", default="double_goal", metavar="NAME", help="of --scaling (default %(default)s)")
    parser.add_argument("--scaling-on", type=int, metavar="N", help="only print the rows of so many devices, as JSON")
    parser.add_argument(
        "--first-result", metavar="WORLD", help="only print the seconds from the call to the first gradient, with the cache as it is"
    )
    return parser


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the benchmark."""
    options = arguments().parse_args(argv)
    if options.first_result:
        _chosen("world", options.first_result, WORLDS)
        sys.stdout.write(f"{_first_result(options.first_result)}\n")
        return
    cli.at_least(1, rounds=options.rounds)
    parts = _chosen("part", options.parts or ",".join(PARTS[: 2 if options.quick else 3]), PARTS)
    names = _chosen("world", options.worlds, WORLDS)
    batches = [64] if options.quick else _batches(options.batches)
    cli.check_outs(json=options.json, figure=options.figure)
    jax.config.update("jax_enable_compilation_cache", False)  # compile times are measured
    if options.scaling_on is not None:
        cli.at_least(1, **{"scaling-on": options.scaling_on})
        sys.stdout.write(json.dumps(scaling.measure_here(options.scene, options.scaling_on, options.rounds)) + "\n")
        return
    rounds = 3 if options.quick else options.rounds
    console = cli.console()
    if options.scaling:
        config.defaults(options.scene, scaling.METHOD)  # raises here what would be raised in each process
        found = _scaling(console, options.scene, rounds)
        if options.json:
            options.json.write_text(json.dumps({"scaling": found} | made_by(), indent=1))
        return
    report: dict[str, Any] = {"rows": [], "pile_up": {}, "update": [], "warm_first_result_s": {}} | made_by()
    if "physics" in parts:
        rows = _physics(console, names, batches, rounds, plain=not options.quick)
        report["rows"] = [vars(r) for r in rows]
        console.print(table(rows))
        if options.figure:
            figure(rows, options.figure)
    if "pile_up" in parts:
        report["pile_up"] = pile_up.compare()
        console.print(pile_up.table(report["pile_up"]))
    if "update" in parts:
        for scene, seed_counts in UPDATED.items():
            timed = updates(scene, "rtc_c", rounds, seed_counts)
            report["update"] += timed
            console.print(updates_table(timed))
    if not options.quick and "physics" in parts:
        report["warm_first_result_s"] = {name: first_result_seconds(name) for name in names}
        for name, seconds in report["warm_first_result_s"].items():
            console.print(f"{name}: first gradient {seconds:.1f} s after the call, with a warm cache")
    if options.json:
        options.json.write_text(json.dumps(report, indent=1))


def _scaling(console: Console, scene: str, rounds: int) -> dict[str, Any]:
    """How updates scale; says on stderr where it is."""

    def watch(counts: Sequence[int]) -> Iterator[int]:
        for count in counts:
            sys.stderr.write(f"benchmark: {count} device{'s' * (count > 1)}\n")
            yield count

    found = scaling.measure(scene, rounds, watch)
    console.print(scaling.table(found, scene))
    for row in found["all_reduce"]:
        console.print(f"all-reduce of one gradient over {row['devices']} devices: {row['bytes']:,} bytes, {row['ms']:.2f} ms")
    return found


def _physics(console: Console, names: Sequence[str], batches: Sequence[int], rounds: int, plain: bool) -> list[Row]:
    """All rows; the plain variant's compilation alone takes minutes, so it can be left out."""
    rows, variants = [], [v for v in VARIANTS if plain or v != "plain"]
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("benchmark", total=len(names) * len(batches) * len(DIRECTIONS))
        for name in names:
            world = WORLDS[name]()
            for batch, direction in ((b, d) for b in batches for d in DIRECTIONS):
                told = f"{name}, batch {batch}, {direction}"
                progress.update(task, description=told)
                if not console.is_terminal:
                    sys.stderr.write(f"benchmark: {told}\n")
                rows += measure(name, world, batch, direction, rounds, variants)
                progress.advance(task)
    return rows


def _chosen(kind: str, text: str, known: Collection[str]) -> list[str]:
    """The names of a comma-separated option, all of them known."""
    names = text.split(",")
    unknown = [n for n in names if n not in known]
    if unknown:
        raise UsageError(f"--{kind}s: no {kind} '{unknown[0]}'; there are {', '.join(known)}")
    return names


def _batches(text: str) -> list[int]:
    try:
        batches = [int(b) for b in text.split(",")]
    except ValueError:
        batches = []
    if not batches or min(batches) < 1:
        raise UsageError(f"--batches {text}: positive whole numbers are needed, such as 16,64")
    return batches


if __name__ == "__main__":
    cli.run(main)
