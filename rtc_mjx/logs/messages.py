"""The protocol buffer messages of the Waymo Open Motion Dataset that we read, declared by field number: facts of the wire format.

Built at import from the tables below, so that no generated file ties us to a version of the protobuf runtime. Fields that are not
listed are skipped by the parser; repeated numbers are read packed and unpacked; fields may come in any order.
"""

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

# message -> field -> (number, type); a type in [] is repeated, a capital letter names another message
WOMD: dict[str, dict[str, tuple[int, str]]] = {
    "Scenario": {
        "timestamps_seconds": (1, "[double]"), "tracks": (2, "[Track]"), "objects_of_interest": (4, "[int32]"),
        "scenario_id": (5, "bytes"), "sdc_track_index": (6, "int32"), "dynamic_map_states": (7, "[DynamicMapState]"),
        "map_features": (8, "[MapFeature]"), "current_time_index": (10, "int32"), "tracks_to_predict": (11, "[RequiredPrediction]"),
    },
    "Track": {"id": (1, "int32"), "object_type": (2, "int32"), "states": (3, "[ObjectState]")},
    "ObjectState": {
        "center_x": (2, "double"), "center_y": (3, "double"), "center_z": (4, "double"), "length": (5, "float"), "width": (6, "float"),
        "height": (7, "float"), "heading": (8, "float"), "velocity_x": (9, "float"), "velocity_y": (10, "float"), "valid": (11, "bool"),
    },
    "RequiredPrediction": {"track_index": (1, "int32"), "difficulty": (2, "int32")},
    "DynamicMapState": {"lane_states": (1, "[TrafficSignalLaneState]")},
    "TrafficSignalLaneState": {"lane": (1, "int64"), "state": (2, "int32"), "stop_point": (3, "MapPoint")},
    "MapPoint": {"x": (1, "double"), "y": (2, "double"), "z": (3, "double")},
    "MapFeature": {
        "id": (1, "int64"), "lane": (3, "LaneCenter"), "road_line": (4, "Line"), "road_edge": (5, "Line"), "stop_sign": (7, "StopSign"),
        "crosswalk": (8, "Area"), "speed_bump": (9, "Area"), "driveway": (10, "Area"),
    },
    "LaneCenter": {
        "speed_limit_mph": (1, "double"), "type": (2, "int32"), "interpolating": (3, "bool"), "polyline": (8, "[MapPoint]"),
        "entry_lanes": (9, "[int64]"), "exit_lanes": (10, "[int64]"), "left_neighbors": (11, "[LaneNeighbor]"),
        "right_neighbors": (12, "[LaneNeighbor]"),
    },
    "LaneNeighbor": {"feature_id": (1, "int64")},
    "Line": {"type": (1, "int32"), "polyline": (2, "[MapPoint]")},
    "StopSign": {"lane": (1, "[int64]"), "position": (2, "MapPoint")},
    "Area": {"polygon": (1, "[MapPoint]")},
    "Example": {"features": (1, "Features")},
    "Features": {"feature": (1, "[FeatureEntry]")},
    "FeatureEntry": {"key": (1, "bytes"), "value": (2, "Values")},
    "Values": {"bytes_list": (1, "BytesList"), "float_list": (2, "FloatList"), "int64_list": (3, "Int64List")},
    "BytesList": {"value": (1, "[bytes]")},
    "FloatList": {"value": (1, "[float]")},
    "Int64List": {"value": (1, "[int64]")},
    "Anything": {},
}  # fmt: skip
PACKAGE = "rtc_mjx.womd"


def declare(table: dict[str, dict[str, tuple[int, str]]]) -> dict[str, Any]:
    """Message classes of a table, by name."""
    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}.proto", package=PACKAGE, syntax="proto2")
    for name, fields in table.items():
        message = file.message_type.add(name=name)
        for field, (number, kind) in fields.items():
            label = kinds.LABEL_REPEATED if kind.startswith("[") else kinds.LABEL_OPTIONAL
            kind = kind.strip("[]")
            if kind in table:
                message.field.add(name=field, number=number, label=label, type=kinds.TYPE_MESSAGE, type_name=f".{PACKAGE}.{kind}")
            else:
                message.field.add(name=field, number=number, label=label, type=getattr(kinds, f"TYPE_{kind.upper()}"))
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{PACKAGE}.{name}")) for name in table}


_CLASSES = declare(WOMD)
Scenario, Example, Anything = _CLASSES["Scenario"], _CLASSES["Example"], _CLASSES["Anything"]
