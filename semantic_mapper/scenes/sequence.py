"""A room as a stream of frames, as a recorded log would give it."""

from __future__ import annotations

from collections.abc import Iterator

from semantic_mapper.scenes.camera import camera_path
from semantic_mapper.scenes.config import CameraPathConfig, NoiseConfig, RoomConfig
from semantic_mapper.scenes.render import render_view
from semantic_mapper.scenes.room import make_room
from semantic_mapper.types import CameraIntrinsics, PosedFrame

FRAME_NS = 66_666_667  # 15 frames a second


def room_frames(
    seed: int,
    count: int,
    intrinsics: CameraIntrinsics,
    *,
    room: RoomConfig = RoomConfig(),
    path: CameraPathConfig = CameraPathConfig(),
    noise: NoiseConfig | None = None,
) -> Iterator[PosedFrame]:
    """``count`` labelled frames (ids of ``labels.ROOMS``) of the room of ``seed``; everything follows from the seed.

    Args:
        seed: Of the room and of the path.
        count: Frames; they are ``path.step_m`` apart.
        intrinsics: Of the camera.
        room, path: What the room and the path may look like.
        noise: Sensor noise, another draw each frame; None for a perfect camera.
    """
    scene = make_room(seed, room)
    for index, T_world_camera in enumerate(camera_path(scene, count, seed, path)):
        noise_seed = None if noise is None else seed * 100_003 + index
        view = render_view(scene, intrinsics, T_world_camera, noise=noise_seed, noise_config=noise or NoiseConfig())
        yield PosedFrame(
            stamp_ns=(index + 1) * FRAME_NS,
            seq=index,
            camera_id="rooms",
            rgb=view.rgb,
            depth_m=view.depth_m,
            label=view.label,
            intrinsics=intrinsics,
            T_world_camera=T_world_camera,
            pose_source="rooms",
        )
