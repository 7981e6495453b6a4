"""A room as a stream of frames, as a recorded log would give it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from research.scenes.arms import draw_arms, hold_arms
from research.scenes.camera import camera_path
from research.scenes.config import CameraPathConfig, NoiseConfig, PoseNoiseConfig, RoomConfig
from research.scenes.pose_noise import drifting_poses
from research.scenes.render import RenderedView, render_view
from research.scenes.room import make_room
from research.scenes.scene import Scene, scene_at
from research.scenes.shots import sequence_shots
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame

FRAME_NS = 66_666_667  # 15 frames a second


@dataclass(frozen=True, slots=True, eq=False)
class RoomView:
    """One frame with the truth that a recorded log would not have.

    Args:
        frame: What the robot gets: noisy picture, noisy depth (None without a depth sensor), its pose as it knows it.
        rendered: The same picture with exact depth and instances.
        T_world_camera: (4, 4) float64, where the camera truly is.
    """

    frame: PosedFrame
    rendered: RenderedView
    T_world_camera: Float64


def room_views(
    seed: int,
    count: int,
    intrinsics: CameraIntrinsics,
    *,
    room: RoomConfig = RoomConfig(),
    path: CameraPathConfig = CameraPathConfig(),
    noise: NoiseConfig | None = None,
    pose_noise: PoseNoiseConfig | None = None,
    scene: Scene | None = None,
) -> Iterator[RoomView]:
    """``count`` labelled views (ids of ``labels.ROOMS``) of the room of ``seed``; everything follows from the seed.

    Args:
        seed: Of the room and of the path.
        count: Frames; they are ``path.step_m`` apart.
        intrinsics: Of the camera.
        room, path: What the room and the path may look like.
        noise: Depth sensor and noise, another draw each frame; None for perfect sensors.
        pose_noise: Drift of the frames' poses; None for exact ones.
        scene: ``make_room(seed, room)``, where the caller has it already.
    """
    scene = make_room(seed, room) if scene is None else scene
    poses = camera_path(scene, count, seed, path)
    arms = draw_arms(seed, room.variety)
    present = (scene_at(scene, index) for index in range(count))
    scenes = present if arms is None else (hold_arms(s, arms, poses[index]) for index, s in enumerate(present))
    frame_poses = poses if pose_noise is None else drifting_poses(poses, seed, pose_noise)
    yield from render_views(seed, scenes, poses, intrinsics, noise=noise, frame_poses=frame_poses)


def render_views(
    seed: int,
    scenes: Iterable[Scene],
    poses: Float64,
    intrinsics: CameraIntrinsics,
    *,
    noise: NoiseConfig | None = None,
    frame_poses: Float64 | None = None,
    camera: int | None = None,
) -> Iterator[RoomView]:
    """One view of each scene, as frames of one camera.

    Args:
        seed: Of the noise.
        scenes: What is there in each frame.
        poses: (N, 4, 4) where the camera is.
        intrinsics: Of the camera.
        noise: Depth sensor and noise, another draw each frame; None for perfect sensors.
        frame_poses: (N, 4, 4) where the robot thinks that it is; None: it knows.
        camera: As of ``sequence_shots``.
    """
    known = poses if frame_poses is None else frame_poses
    shots = [None] * len(poses) if noise is None else sequence_shots(poses, seed, noise, camera)
    for index, (scene, shot) in enumerate(zip(scenes, shots, strict=True)):
        view = render_view(
            scene,
            intrinsics,
            poses[index],
            noise=None if noise is None else seed * 100_003 + index,
            noise_config=noise or NoiseConfig(),
            shot=shot,
        )
        frame = PosedFrame(
            stamp_ns=(index + 1) * FRAME_NS,
            seq=index,
            camera_id="rooms",
            rgb=view.rgb,
            depth_m=None if noise is not None and noise.depth == "none" else view.depth_m,
            label=view.label,
            intrinsics=intrinsics,
            T_world_camera=known[index],
            pose_source="rooms",
        )
        yield RoomView(frame, view, poses[index])


def room_frames(
    seed: int,
    count: int,
    intrinsics: CameraIntrinsics,
    *,
    room: RoomConfig = RoomConfig(),
    path: CameraPathConfig = CameraPathConfig(),
    noise: NoiseConfig | None = None,
    pose_noise: PoseNoiseConfig | None = None,
) -> Iterator[PosedFrame]:
    """The frames of ``room_views``, without the truth."""
    for view in room_views(seed, count, intrinsics, room=room, path=path, noise=noise, pose_noise=pose_noise):
        yield view.frame
