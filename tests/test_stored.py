"""Programs that were folded once are read back the same; whatever could make them others makes another entry."""

import dataclasses
import itertools
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from worlds import draw, make

from rtc_mjx import cache
from rtc_mjx.physics import fast, load, specialised_step
from rtc_mjx.specialise import kept, specialise
from rtc_mjx.specialise.stored import to_arrays, to_program

QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx")


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty cache folder; steps that this process has at hand are forgotten before and after."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    fast._specialised_step.cache_clear()
    yield cache.folder() / "programs"
    fast._specialised_step.cache_clear()


def everything(x, y):
    """Every kind of node: types, constants told apart by their bits, what is held and what is saved, unused and repeated inputs."""
    held, saved = lax.stop_gradient(jnp.sin(x)), checkpoint_name(x * x, "square")
    odd, whole = jnp.array([-0.0, jnp.nan, jnp.inf]), jnp.floor(x).astype(int)
    return {
        "a": held * saved + odd,
        "b": [x > 0, whole + 3, jnp.zeros((0, 2)), y[:1]],
        "c": x,
        "d": x[1],
        "e": jnp.eye(2),
    }


@pytest.mark.parametrize("wide", [True, False])
def test_a_program_read_back_is_the_same_bit_for_bit(wide):
    with jax.enable_x64(wide):
        x = jnp.asarray([0.3, -0.7, 1.9])
        made = specialise(everything, x, jnp.ones(4))
        read = dataclasses.replace(made, program=to_program(to_arrays(made.program)))
        assert (read.program.inputs, read.program.types) == (made.program.inputs, made.program.types)
        assert_same(both_ways(made, x, jnp.ones(4)), both_ways(read, x, jnp.ones(4)))


@pytest.mark.parametrize("name", ["double_goal", "three_cars"])
def test_stored_programs_of_a_world_are_stored_the_same_again(name, folder):
    world = make(name)
    specialised_step(world)
    (file,) = folder.iterdir()
    for program in kept(file.stem, lambda: pytest.fail("folded again")).values():
        arrays = to_arrays(program)
        again = to_arrays(to_program(arrays))
        assert arrays.keys() == again.keys() and all(np.array_equal(arrays[k], again[k]) for k in arrays)


def test_a_step_read_back_has_the_values_and_gradients_of_the_folded_one(monkeypatch):
    world = make("car_2")
    arguments = jax.tree.map(lambda x: x.astype(jnp.float32), draw(world, 8, seed=3).arguments(world))
    with monkeypatch.context() as patch:
        patch.setattr(fast, "kept", lambda _, fold: fold())
        folded = both_ways(jax.vmap(specialised_step(world)), *arguments)
    fast._specialised_step.cache_clear()
    specialised_step(world)  # writes
    fast._specialised_step.cache_clear()
    monkeypatch.setattr(fast, "_folded", lambda *_: pytest.fail("folded again"))
    assert_same(folded, both_ways(jax.vmap(specialised_step(world)), *arguments))


def both_ways(function, *inputs):
    """Values, and the gradients of their sum with respect to all inputs."""

    def total(*inputs):
        out = function(*inputs)
        return sum(jnp.sum(x) for x in jax.tree.leaves(out) if jnp.issubdtype(x.dtype, jnp.inexact)), out

    numbers = tuple(range(len(inputs)))
    return jax.jit(jax.grad(total, numbers, has_aux=True), compiler_options=QUICK)(*inputs)


def assert_same(one, two):
    one, two = jax.tree.leaves(one), jax.tree.leaves(two)
    assert [(x.shape, x.dtype) for x in one] == [(x.shape, x.dtype) for x in two]
    assert [np.asarray(x).tobytes() for x in one] == [np.asarray(x).tobytes() for x in two]


def folding(count):
    """What to fold, and says how often it was."""
    return lambda: {"double": (next(count), specialise(lambda x: 2 * x, jnp.ones(2)).program)[1]}


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda whole: whole[:200], "damaged"),
        (lambda whole: whole[:-1], "damaged"),
        (lambda whole: b"", "damaged"),
        (lambda whole: whole[:1000] + bytes([whole[1000] ^ 1]) + whole[1001:], "damaged"),
        (lambda whole: whole, None),
    ],
)
def test_a_damaged_entry_is_made_again_and_said(damage, said, folder, caplog):
    times = itertools.count()
    kept("entry", folding(times))
    file = folder / "entry.npz"
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    double = kept("entry", folding(times))["double"]
    assert np.array_equal(double(jnp.array([1.0, 3.0]))[0], [2.0, 6.0])
    assert next(times) == (2 if said else 1)
    assert ("entry.npz is damaged" in caplog.text) == bool(said)
    assert file.read_bytes()[-32:] == whole[-32:]
    assert [f.name for f in folder.iterdir()] == ["entry.npz"]


def test_a_program_that_binds_natively_is_not_stored(folder):
    times = itertools.count()
    for _ in range(2):
        made = kept("entry", lambda: {"sorted": (next(times), specialise(jnp.sort, jnp.ones(3)).program)[1]})
        assert np.array_equal(made["sorted"](jnp.array([2.0, 1.0, 3.0]))[0], [1.0, 2.0, 3.0])
    assert next(times) == 2 and not folder.exists()


def test_a_program_that_binds_natively_is_refused_as_arrays():
    with pytest.raises(ValueError, match="natively"):
        to_arrays(specialise(jnp.sort, jnp.ones(3)).program)


def test_without_a_place_to_write_programs_are_made_and_it_is_said(tmp_path, monkeypatch, caplog):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    double = kept("entry", folding(itertools.count()))["double"]
    assert np.array_equal(double(jnp.array([1.0, 3.0]))[0], [2.0, 6.0])
    assert "nothing can be kept" in caplog.text


def test_writers_and_readers_at_once_see_whole_entries(tmp_path, caplog):
    file = tmp_path / "entry.npz"

    def write_and_read(number):
        for _ in range(20):
            cache.write_arrays(file, {str(i): np.full(3000, number) for i in range(4)})
            held = cache.read_arrays(file)
            assert held is not None and len({int(x) for a in held.values() for x in a}) == 1

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write_and_read, range(8)))
    assert not caplog.records and list(tmp_path.iterdir()) == [file]


def changed_timestep(world):
    world.mj.opt.timestep *= 1 + 1e-12


def changed_free_part(world):
    world.free.mj.dof_damping[0] += 1e-12


def changed_user_part(world):
    world.one_user.mj.geom_friction[-1, 0] += 1e-12


@pytest.mark.parametrize("change", [changed_timestep, changed_free_part, changed_user_part])
def test_worlds_that_differ_in_one_number_share_no_entry(change):
    world = load("driving", road_users=1)
    before = fast._fingerprint(world)
    assert fast._fingerprint(load("driving", road_users=1)) == before
    change(world)
    assert fast._fingerprint(world) != before


def test_another_precision_version_or_source_is_another_entry(tmp_path, monkeypatch):
    world, source = make("double_goal"), tmp_path / "step.py"
    source.write_text("1")
    monkeypatch.setattr(fast, "SOURCES", [*fast.SOURCES, source])
    prints = [fast._fingerprint(world)]
    with jax.enable_x64(True):
        prints.append(fast._fingerprint(world))
    source.write_text("2")
    prints.append(fast._fingerprint(world))
    version = cache.metadata.version
    for package in PACKAGES:
        with monkeypatch.context() as patch:
            patch.setattr(cache.metadata, "version", lambda name, package=package: version(name) + ".1" * (name == package))
            prints.append(fast._fingerprint(world))
    assert len(set(prints)) == len(prints) == 3 + len(PACKAGES)
    assert prints[2] == fast._fingerprint(world)


def test_every_source_of_the_step_and_of_folding_counts():
    names = {f"{file.parent.name}/{file.name}" for file in fast.SOURCES}
    assert {"physics/step.py", "physics/contact.py", "specialise/graph.py", "specialise/interpret.py", "rtc_mjx/pytree.py"} <= names
