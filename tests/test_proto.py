"""The .proto file: in step with the messages, correct, and never renumbered."""

import re

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto

from schemas import proto
from schemas.codec import SCALARS, all_models, field_plans, file_descriptor

PINNED = """
Point2.x_px = 1 double
Point2.y_px = 2 double
Vector3.x = 1 double
Vector3.y = 2 double
Vector3.z = 3 double
Quaternion.w = 1 double
Quaternion.x = 2 double
Quaternion.y = 3 double
Quaternion.z = 4 double
Pose.translation_m = 1 Vector3
Pose.rotation_wxyz = 2 Quaternion
LayerCorners.layer = 1 int64
LayerCorners.corners_px = 2 repeated Point2
LayerCorners.sigma_px = 3 double
PlanarPose.T_cam_marker = 1 Pose
PlanarPose.reprojection_rms_px = 2 double
WarpGrid.rows = 1 int64
WarpGrid.columns = 2 int64
WarpGrid.points_px = 3 repeated Point2
Detection.family = 1 string
Detection.marker_id = 2 int64
Detection.corners_px = 3 repeated Point2
Detection.layers = 4 repeated LayerCorners
Detection.correlation = 5 double
Detection.hamming = 6 int64
Detection.method = 7 string
Detection.planar_poses = 8 repeated PlanarPose
Detection.T_cam_marker = 9 Pose
Detection.covariance = 10 repeated double
Detection.reprojection_rms_px = 11 double
Detection.warp_grid = 12 WarpGrid
Detections.t_capture_ns = 1 int64
Detections.camera = 2 string
Detections.width_px = 3 int64
Detections.height_px = 4 int64
Detections.detections = 5 repeated Detection
PortToPort.range_m = 1 double
PortToPort.axial_m = 2 double
PortToPort.lateral_m = 3 double
PortToPort.closing_speed_m_s = 4 double
PortToPort.lateral_speed_m_s = 5 double
PortToPort.misalignment_rad = 6 double
PortToPort.roll_rad = 7 double
PortToPort.corridor_angle_rad = 8 double
PortToPort.in_corridor = 9 bool
RelativeState.t_capture_ns = 1 int64
RelativeState.mode = 2 Mode
RelativeState.T_chaser_target = 3 Pose
RelativeState.v_chaser_target_m_s = 4 Vector3
RelativeState.omega_chaser_target_in_target_rad_s = 5 Vector3
RelativeState.covariance = 6 repeated double
RelativeState.nis = 7 double
RelativeState.nis_dof = 8 int64
RelativeState.age_s = 9 double
RelativeState.hypothesis_probability = 10 double
RelativeState.marker_ids = 11 repeated int64
RelativeState.layers = 12 repeated int64
RelativeState.rejections = 13 repeated string
RelativeState.port = 14 PortToPort
Truth.t_capture_ns = 1 int64
Truth.T_chaser_target = 2 Pose
Truth.v_chaser_target_m_s = 3 Vector3
Truth.omega_chaser_target_in_target_rad_s = 4 Vector3
NodeHealth.t_publish_ns = 1 int64
NodeHealth.node = 2 string
NodeHealth.pid = 3 int64
NodeHealth.uptime_s = 4 double
NodeHealth.cpu_s = 5 double
NodeHealth.received = 6 int64
NodeHealth.published = 7 int64
NodeHealth.dropped = 8 int64
NodeHealth.refused = 9 int64
NodeHealth.latency_s = 10 double
NodeHealth.note = 11 string
"""
"""What has been published: add lines, never change or remove one."""

SCALAR_NUMBERS = {name: number for number, name in SCALARS.values()}
FIELD = re.compile(r"  (?P<label>optional |repeated )?(?P<type>\w+) (?P<name>\w+) = (?P<number>\d+);")


def test_the_file_is_in_step_with_the_messages() -> None:
    assert proto.PATH.read_text() == proto.proto_text(), "run `python -m schemas.proto`"


def test_no_field_was_renumbered_retyped_or_removed() -> None:
    current = set()
    for model in all_models():
        for plan in field_plans(model):
            kind = SCALARS[plan.type][1] if plan.type in SCALARS else plan.type.__name__
            repeated = "repeated " if plan.repeated else ""
            current.add(f"{model.__name__}.{plan.name} = {plan.number} {repeated}{kind}")
    assert set(PINNED.strip().splitlines()) <= current


def test_the_text_describes_what_travels() -> None:
    """Read by a parser of its own, the file gives the very descriptor by which messages are encoded."""
    expected = FileDescriptorProto()
    file_descriptor().CopyToProto(expected)
    for message in expected.message_type:
        for field in message.field:
            field.ClearField("json_name")
    assert parsed(proto.PATH.read_text()) == expected


def parsed(text: str) -> FileDescriptorProto:
    """Parse the little of the language that the file uses; anything else fails."""
    file = FileDescriptorProto(name=proto.PATH.name)
    lines = [line for line in text.splitlines() if line and not line.lstrip().startswith("//")]
    enum_names = re.findall(r"^enum (\w+)", text, re.MULTILINE)
    block = None
    for line in lines:
        if line == "}":
            block = None
        elif opened := re.fullmatch(r"(message|enum) (\w+) {", line):
            block = (file.message_type if opened[1] == "message" else file.enum_type).add(name=opened[2])
        elif member := re.fullmatch(r"  (\w+) = (\d+);", line):
            block.value.add(name=member[1], number=int(member[2]))
        elif field := FIELD.fullmatch(line):
            add_field(block, field, enum_names)
        elif stated := re.fullmatch(r'syntax = "(\w+)";', line):
            file.syntax = stated[1]
        else:
            file.package = re.fullmatch(r"package (\w+);", line)[1]
    return file


def add_field(message, field: re.Match, enum_names: list[str]) -> None:
    added = message.field.add(name=field["name"], number=int(field["number"]))
    repeated = field["label"] == "repeated "
    added.label = FieldDescriptorProto.LABEL_REPEATED if repeated else FieldDescriptorProto.LABEL_OPTIONAL
    if field["type"] in SCALAR_NUMBERS:
        added.type = SCALAR_NUMBERS[field["type"]]
    else:
        is_enum = field["type"] in enum_names
        added.type = FieldDescriptorProto.TYPE_ENUM if is_enum else FieldDescriptorProto.TYPE_MESSAGE
        added.type_name = f".relnav.{field['type']}"
    if field["label"] == "optional ":
        added.proto3_optional = True
        added.oneof_index = len(message.oneof_decl)
        message.oneof_decl.add(name=f"_{field['name']}")
