"""Depth of frames that a field of one scene renders, without anything known beforehand."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
import cv2
import numpy as np

from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.render import render_image
from semantic_mapper.imaging import working_intrinsics
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import Float32, PosedFrame

OPAQUE = 0.5  # opacity from which on a ray has met a surface


def rendered_depth(field: LearnedField, frame: PosedFrame, width: int) -> Float32:
    """z (H, W) in metres at the size of the frame, 0 where a ray meets nothing.

    Args:
        field: Holds the scene.
        frame: Pose and camera.
        width: Of the rendering, in pixels; each pixel of the frame has the nearest one.
    """
    k = working_intrinsics(frame.intrinsics, width)
    sources = field.encode(stack_sources([view_from_frame(frame, field.label_set, k.width)]))
    nothing = np.zeros((k.height, k.width), np.float32)
    scene = (field, sources, k, frame.T_world_camera, nothing, field.sampling, 0)
    found = render_image(*scene, stamp_ns=frame.stamp_ns)
    depth = (found.depth_m * (found.opacity > OPAQUE)).view(k.height, k.width).numpy()
    size = (frame.intrinsics.width, frame.intrinsics.height)
    return np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
