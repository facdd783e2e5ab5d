"""What is loaded, under which names, and what is refused."""

import mujoco
import numpy as np
import pytest

from rtc_mjx.errors import UnsupportedWorldError, UsageError
from rtc_mjx.physics import asset_names, from_spec, load

BODY = """<mujoco><option integrator="implicitfast" {option}/><worldbody>
<body name="a"><{joint}/><geom name="ball" type="{geom}" size=".1 .1 .1"/><site name="s"/></body>
<body name="b" pos="1 0 0"><joint name="q" type="slide"/><geom name="other" size=".1"/></body></worldbody>{more}</mujoco>"""
PLAIN = {"option": "", "joint": 'joint name="j" type="slide"', "geom": "sphere", "more": ""}
REFUSED = {
    "elliptic": ({"option": 'cone="elliptic"'}, "elliptic"),
    "integrator": ({"option": 'density="0"', "joint": PLAIN["joint"]}, "RK4"),
    "friction loss": ({"joint": 'joint name="j" type="slide" frictionloss=".1"'}, "j"),
    "ball joint": ({"joint": 'joint name="j" type="ball"'}, "j"),
    "free joint": ({"joint": 'freejoint name="j"'}, "j"),
    "box": ({"geom": "box"}, "ball"),
    "fluid": ({"option": 'density="1000"'}, "density"),
    "equality": ({"more": '<equality><joint name="tie" joint1="j" joint2="q"/></equality>'}, "tie"),
    "tendon": ({"more": '<tendon><fixed name="cord"><joint joint="j" coef="1"/></fixed></tendon>'}, "cord"),
    "actuator state": ({"more": '<actuator><general name="slow" joint="j" dyntype="filter" dynprm="1"/></actuator>'}, "slow"),
    "actuated force limit": ({"joint": 'joint name="j" type="slide" actuatorfrclimited="true" actuatorfrcrange="-1 1"'}, "j"),
}


def spec(**changes: str) -> mujoco.MjSpec:
    text = BODY.format(**{**PLAIN, **changes})
    return mujoco.MjSpec.from_string(text.replace("implicitfast", "RK4") if changes.get("option") == 'density="0"' else text)


def test_a_supported_model_is_taken():
    assert from_spec(spec()).mj.nv == 2


@pytest.mark.parametrize("case", REFUSED)
def test_what_the_derivative_does_not_cover_is_refused_by_name(case):
    changes, named = REFUSED[case]
    with pytest.raises(UnsupportedWorldError, match=named):
        from_spec(spec(**changes), name="odd")


def test_colliding_mocap_bodies_must_be_alike():
    text = """<mujoco><option integrator="implicitfast"/><worldbody><body name="a"><joint type="slide"/><geom size=".1"/></body>
    <body name="u" mocap="true" pos="2 0 0"><geom type="capsule" size=".1 .1" friction="1 .1 .1"/></body>
    <body name="v" mocap="true" pos="4 0 0"><geom type="capsule" size=".1 .1" friction=".5 .1 .1"/></body></worldbody></mujoco>"""
    with pytest.raises(UnsupportedWorldError, match="friction"):
        from_spec(mujoco.MjSpec.from_string(text))


@pytest.mark.parametrize("name", asset_names())
def test_every_asset_loads_and_has_what_scenes_ask_for(name):
    world = load(name)
    cameras = [world.mj.camera(i).name for i in range(world.mj.ncam)]
    assert len(cameras) >= 2 and "top" in [camera.rpartition("/")[2] for camera in cameras]
    assert world.mj.nq == world.mj.nv
    assert all(world.control(c) == i for i, c in enumerate(world.control_names))
    assert world.free.planar


def test_unknown_worlds_and_names_are_answered_with_what_there_is():
    with pytest.raises(UsageError, match="double_goal, driving"):
        load("intersektion")
    with pytest.raises(UsageError, match="missing.xml"):
        load("/nowhere/missing.xml")
    world = load("driving")
    for ask, wanted in (
        (world.joint, "car0/steering"),
        (world.site, "car0/rear_axle"),
        (world.body, "car0/chassis"),
        (world.control, "car0/drive"),
    ):
        with pytest.raises(UsageError, match=f"'wheel'.*{wanted}"):
            ask("wheel")


def test_a_broken_file_is_named(tmp_path):
    path = tmp_path / "broken.xml"
    path.write_text("<mujoco><worldbody><body>")
    with pytest.raises(UsageError, match="broken.xml"):
        load(path)


@pytest.mark.parametrize(("cars", "users"), [(1, 0), (1, 8), (3, 2)])
def test_cars_and_road_users_are_copied(cars, users):
    world = load("driving", cars=cars, road_users=users)
    assert world.control_names == tuple(f"car{k}/{c}" for k in range(cars) for c in ("drive", "steer"))
    assert world.mj.nv == 4 * cars and len(world.mocap_ids) == users
    assert np.allclose(world.default_sizes, [4.6, 1.9])


@pytest.mark.parametrize(
    ("options", "named"), [({"road_users": -1}, "road_users=-1"), ({"cars": 0}, "cars=0"), ({"cars": 10_000}, "cars=10000")]
)
def test_impossible_numbers_of_copies_are_refused(options, named):
    with pytest.raises(UsageError, match=named):
        load("driving", **options)


def test_copies_need_something_to_copy():
    with pytest.raises(UsageError, match="car0/chassis"):
        load("double_goal", cars=2)


def test_fingerprints_tell_worlds_apart():
    assert load("driving").fingerprint == load("driving").fingerprint
    assert load("driving").fingerprint != load("driving", road_users=2).fingerprint
