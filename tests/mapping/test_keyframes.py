import numpy as np
import torch

from semantic_mapper.config import KeyframeConfig
from semantic_mapper.fields.views import EncodedViews
from semantic_mapper.geometry import make_pose
from semantic_mapper.mapping.keyframes import Keyframe, KeyframeStore, pose_distances
from semantic_mapper.types import CameraIntrinsics

INTRINSICS = CameraIntrinsics(40.0, 40.0, 39.5, 29.5, 80, 60)
WALL = np.full((60, 80), 2.0, np.float32)
NOTHING = EncodedViews(
    *(torch.zeros(1, n, 1, 1) for n in (1, 3, 5)), torch.zeros(1, 3, 3), torch.zeros(1, 4, 4), torch.zeros(1, 1, 1)
)


def pose(x: float = 0.0, yaw_deg: float = 0.0) -> np.ndarray:
    return make_pose((0.0, np.radians(yaw_deg), 0.0), (x, 0.0, 0.0))


def keyframe(seq: int, T: np.ndarray, labelled: bool = False, depth: np.ndarray = WALL) -> Keyframe:
    return Keyframe(seq, seq, T, INTRINSICS, depth, NOTHING, labelled)


def test_a_frame_becomes_a_keyframe_after_moving_or_turning_enough():
    store = KeyframeStore(KeyframeConfig(translation_m=0.2))
    assert store.wants(pose())
    store.add(keyframe(0, pose()))
    assert not store.wants(pose(0.1, 5))
    assert store.wants(pose(0.25))
    assert store.wants(pose(0.0, 20))


def test_within_a_room_the_one_nearest_to_another_goes(rng: np.random.Generator):
    """Against brute force over pairs, one at a time."""
    store, truth = KeyframeStore(KeyframeConfig(capacity=12)), list[Keyframe]()
    for seq in range(60):
        new = keyframe(seq, pose(rng.uniform(0, 4), rng.uniform(-180, 180)), labelled=seq % 20 == 3)
        store.add(new)
        truth.append(new)
        if len(truth) > 12:
            spacing = {}
            for k in truth[:-1]:
                pairs = [pose_distances(k.T_world_camera, o.T_world_camera) for o in truth if o is not k]
                spacing[k.seq] = min(float(moved + turned / 60) for moved, turned in pairs)
            least = min((k for k in truth[:-1] if not k.labelled), key=lambda k: spacing[k.seq])
            truth = [k for k in truth if k is not least]
        assert [k.seq for k in store.keyframes] == [k.seq for k in truth]


def test_what_the_camera_has_left_behind_goes_before_what_is_round_it():
    store = KeyframeStore(KeyframeConfig(capacity=20))
    for seq in range(200):  # ten rooms, 20 metres apart, each with twenty keyframes that are half a metre apart
        room, place = divmod(seq, 20)
        store.add(keyframe(seq, pose(20.0 * room + 0.5 * (place % 10), 30.0 * (place // 10))))
        if place == 19:
            here = sum(k.seq // 20 == room for k in store.keyframes)
            assert here >= 12, "most of them are where the camera is, in the last room as in the first"
    assert len({k.seq // 20 for k in store.keyframes}) > 1, "and some are left of the room before"


def test_choice_covers_the_frustum_rather_than_taking_the_nearest_centres():
    store = KeyframeStore(KeyframeConfig())
    store.add(keyframe(0, pose(0.02, 35)))  # near, but looks right: half of the query's view
    store.add(keyframe(1, pose(0.03, 36)))
    store.add(keyframe(2, pose(0.04, 37)))
    store.add(keyframe(3, pose(0.8, -15)))  # farther away, sees the left half
    chosen = [k.seq for k in store.choose(pose(), INTRINSICS, WALL, 2)]
    assert 3 in chosen and len(chosen) == 2


def test_occluded_views_are_not_chosen():
    store = KeyframeStore(KeyframeConfig())
    near_wall = np.full((60, 80), 0.5, np.float32)  # something stands right before this camera
    store.add(keyframe(0, pose(0.0), depth=near_wall))
    store.add(keyframe(1, pose(0.5)))
    assert [k.seq for k in store.choose(pose(), INTRINSICS, WALL, 1)] == [1]
