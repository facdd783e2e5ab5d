"""From a recording to scenes: which roads are kept, where signals stand, what is known of connectivity, and the cache's entries."""

import dataclasses

import numpy as np
import pytest

from rtc_mjx.errors import UsageError
from rtc_mjx.logs import AMBER, GREEN, NO_SIGNAL, RED, store, womd
from rtc_mjx.logs.convert import Options, convert
from rtc_mjx.logs.road import prepare
from tests import recorded

SMALL = Options(lanes=6, points=8, road_users=4, edges=8, crosswalks=2)


def from_scenario(message):
    return womd.read(message.SerializeToString(), "made")


def far_and_near():
    """The road of `recorded` straight on for 160 m, and beside its start, 30 to 50 m off, streets that nothing leads to."""
    held = recorded.scenario()
    for number in range(5):
        y = 30.0 + 5 * number
        feature = held.map_features.add(id=100 + number)
        feature.lane.type = 2
        for x in range(0, 41, 4):
            feature.lane.polyline.add(**recorded.place(x - 20, y))
        feature = held.map_features.add(id=200 + number)
        for x in range(0, 41, 4):
            feature.road_edge.polyline.add(**recorded.place(x - 20, y + 2))
    return held


def test_roads_that_the_agent_can_reach_are_kept_before_those_that_are_merely_near():
    """The way on begins 55 m ahead; the edge beside it is cut in pieces that lie up to 150 m ahead."""
    held = far_and_near()
    edge = next(feature for feature in held.map_features if feature.id == 21).road_edge.polyline
    for index, point in enumerate(edge):
        point.y += 0.5 * (index // 10 % 2)  # not straight, so that it has many segments
    recording = from_scenario(held)
    count = len(prepare(recording, 8).edges) - 6
    conversion = convert(recording, dataclasses.replace(SMALL, lanes=3, edges=count))
    scene = conversion.scenes[0].scene
    assert np.allclose(scene.road.lanes[:3, 0], [[-5, 0], [55, 0], [55, 0]])
    assert np.max(scene.road.edges[..., 0]) > 145 and np.max(scene.road.edges[..., 1]) < 45
    assert conversion.dropped["lanes beyond those that fit"] == 2 * 5
    assert "scenes in which the log comes nearest to a lane or road edge that does not fit" not in conversion.dropped


def test_what_is_kept_tells_nothing_of_where_the_agent_went():
    """Its path after t = 0 turns round; the same roads are kept."""
    recording = from_scenario(far_and_near())
    turned = dataclasses.replace(recording.tracks, pose=recording.tracks.pose.copy())
    turned.pose[0, 1:, 0] = 2 * turned.pose[0, 0, 0] - turned.pose[0, 1:, 0]
    options = dataclasses.replace(SMALL, lanes=3, edges=4)
    one, other = (convert(dataclasses.replace(recording, tracks=t), options).scenes[0].scene for t in (recording.tracks, turned))
    assert np.array_equal(one.road.lanes, other.road.lanes) and np.array_equal(one.road.edges, other.road.edges)


def test_scenes_whose_log_leaves_the_kept_roads_are_counted():
    dropped = convert(from_scenario(recorded.scenario()), dataclasses.replace(SMALL, edges=1)).dropped
    assert dropped["scenes in which the log comes nearest to a lane or road edge that does not fit"] == 1  # the slower one stays


# Signals


def with_stop(x, y=0.0, lane=1):
    """The light is logged for a lane, and its stop point is where it is said to be."""
    held = recorded.scenario()
    for state in held.dynamic_map_states:
        light = state.lane_states[0]
        light.lane = lane
        light.stop_point.CopyFrom(type(light.stop_point)(**recorded.place(x, y)))
    return from_scenario(held)


@pytest.mark.parametrize(("x", "lanes"), [(0.0, [0]), (20.0, [0]), (40.0, [1, 2]), (60.0, [1, 2])])
def test_a_light_whose_stop_point_is_past_mid_lane_rules_the_lanes_that_go_on(x, lanes):
    scene = convert(with_stop(x), SMALL).scenes[0].scene
    assert np.flatnonzero(np.any(scene.signals != NO_SIGNAL, axis=0)).tolist() == lanes
    assert all([scene.signals[t, lane] for t in (0, 45, 90)] == [RED, AMBER, GREEN] for lane in lanes)


@pytest.mark.parametrize(("x", "far"), [(0.0, 0), (20.0, 91), (40.0, 91), (58.0, 0)])
def test_lights_that_stand_far_from_their_stop_point_are_counted(x, far):
    assert prepare(with_stop(x), 8).notes.get("signal states put more than 5 m from their stop point", 0) == far


def test_a_light_at_the_end_of_a_lane_that_nothing_follows_is_dropped_and_counted():
    roads = prepare(with_stop(158.0, lane=2), 8)
    assert not roads.signals.any() and roads.notes["of these, dropped: no lane goes on"] == 91


def test_what_is_logged_for_a_lane_itself_stays():
    recording = with_stop(60.0)
    told = recording.signals
    stop, state = np.concatenate([told.stop, told.stop[:1]]), np.append(told.state, 6)
    own = dataclasses.replace(told, time=np.append(told.time, 0), lane=(*told.lane, "2"), state=state, stop=stop)
    table = prepare(dataclasses.replace(recording, signals=own), 8).signals
    assert table[0].tolist() == [NO_SIGNAL, GREEN, RED] and table[1].tolist() == [NO_SIGNAL, RED, RED]


def test_stop_points_that_are_no_place_change_nothing():
    recording = with_stop(0.0, lane=2)
    told = recording.signals
    for odd in (np.nan, np.inf, 1e300):
        table = prepare(dataclasses.replace(recording, signals=dataclasses.replace(told, stop=np.full_like(told.stop, odd))), 8).signals
        assert table[0].tolist() == [NO_SIGNAL, RED, NO_SIGNAL]


# Connectivity


def test_a_scenario_without_entries_and_exits_is_not_connected():
    held = recorded.scenario()
    for feature in held.map_features:
        feature.lane.ClearField("exit_lanes") if feature.HasField("lane") else None
        feature.lane.ClearField("entry_lanes") if feature.HasField("lane") else None
    conversion = convert(from_scenario(held), SMALL)
    assert {scene.connectivity for scene in conversion.scenes} == {"derived"}


# The cache


@pytest.fixture
def kept(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    file = tmp_path / "shard"
    file.write_bytes(recorded.tfrecord(*(recorded.scenario(f"s{i}").SerializeToString() for i in range(3))))
    return file


def test_other_code_is_another_entry(kept, tmp_path, monkeypatch):
    source = tmp_path / "convert.py"
    source.write_text("1")
    monkeypatch.setattr(store, "SOURCES", [*store.SOURCES, source])
    before = store.entry(kept, SMALL)
    source.write_text("2")
    assert store.entry(kept, SMALL) != before


def test_every_source_of_conversion_counts():
    assert {"convert.py", "road.py", "reach.py", "levels.py", "window.py", "womd.py", "store.py"} <= {file.name for file in store.SOURCES}


@pytest.mark.parametrize("writable", [True, False])
def test_recordings_are_listed_with_names_and_sums_and_read_one_by_one(kept, tmp_path, writable):
    if not writable:
        (tmp_path / "cache").write_text("a file where the folder should be")
    found = list(store.listed([kept], SMALL))
    whole = [became for _, became in store.converted(kept, SMALL)]
    assert [held.scenes for held in found] == [tuple(scene.name for scene in became.scenes) for became in whole]
    assert [(held.notes, held.dropped) for held in found] == [(became.notes, became.dropped) for became in whole]
    assert {held.connectivity for held in found} == {"logged"} and [held.number for held in found] == [0, 1, 2]
    ((number, one),) = store.conversions(kept, SMALL, {1})
    assert number == 1 and [scene.name for scene in one.scenes] == ["s1/11", "s1/12"]


def test_recordings_of_which_nothing_can_be_made_are_listed_with_the_reason(kept, caplog):
    found = list(store.listed([kept], dataclasses.replace(SMALL, start=5.0)))
    assert len(found) == 3 and all("from 5 s on" in held.refused and not held.scenes for held in found)
    assert sum("from 5 s on" in r.message for r in caplog.records) == 3
    with pytest.raises(UsageError, match="no scene can be made"):
        list(store.scenes([kept], dataclasses.replace(SMALL, start=5.0)))
    assert sum("from 5 s on" in r.message for r in caplog.records) == 6
