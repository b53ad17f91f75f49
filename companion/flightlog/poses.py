"""Poses and paths in Foxglove's own schemas (protobuf), so that its 3D view shows a flight as it is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from foxglove import messages as fox
from numpy.typing import NDArray

WORLD_FRAME = "world"
TRANSFORM_TOPIC = "/tf"
PATH_TOPIC = "/path"
POSE_SCHEMA = fox.PoseInFrame.get_schema()
TRANSFORM_SCHEMA = fox.FrameTransform.get_schema()
SCENE_SCHEMA = fox.SceneUpdate.get_schema()
PATH_COLOR = (0.12, 0.47, 0.71, 1.0)


def _timestamp(log_time_ns: int) -> fox.Timestamp:
    return fox.Timestamp(sec=log_time_ns // 1_000_000_000, nsec=log_time_ns % 1_000_000_000)


def encode_pose(
    log_time_ns: int, frame: str, position: Sequence[float], quaternion_wxyz: Sequence[float]
) -> tuple[bytes, bytes]:
    """Return a PoseInFrame in the world and the FrameTransform world → `frame`, both encoded."""
    stamp = _timestamp(log_time_ns)
    w, x, y, z = map(float, quaternion_wxyz)
    rotation = fox.Quaternion(x=x, y=y, z=z, w=w)
    translation = fox.Vector3(x=float(position[0]), y=float(position[1]), z=float(position[2]))
    pose = fox.PoseInFrame(
        timestamp=stamp, frame_id=WORLD_FRAME, pose=fox.Pose(position=translation, orientation=rotation)
    )
    transform = fox.FrameTransform(
        timestamp=stamp,
        parent_frame_id=WORLD_FRAME,
        child_frame_id=frame,
        translation=translation,
        rotation=rotation,
    )
    return pose.encode(), transform.encode()


def encode_path(log_time_ns: int, name: str, points_enu: NDArray[np.float64]) -> bytes:
    """Return a SceneUpdate with one line strip through `points_enu` (N, 3) m, encoded."""
    red, green, blue, alpha = PATH_COLOR
    line = fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineStrip,
        pose=fox.Pose(position=fox.Vector3(), orientation=fox.Quaternion(w=1.0)),
        thickness=2.0,
        scale_invariant=True,
        points=[fox.Point3(x=float(x), y=float(y), z=float(z)) for x, y, z in points_enu],
        color=fox.Color(r=red, g=green, b=blue, a=alpha),
    )
    entity = fox.SceneEntity(timestamp=_timestamp(log_time_ns), frame_id=WORLD_FRAME, id=name, lines=[line])
    return fox.SceneUpdate(entities=[entity]).encode()
