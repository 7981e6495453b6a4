"""Which frames corrected poses are of: those in the history, those that have left it, or none at all."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Sequence

from semantic_mapper.errors import MapError
from semantic_mapper.geometry import check_pose
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.correction.history import FrameEntry
from semantic_mapper.mapping.correction.pose_correction import CorrectedPoses, PosePair
from semantic_mapper.types import Float64

_log = get_logger(__name__)


class FrozenFrames:
    """The stamps of frames that have left the history, 8 bytes each for as long as the map lives."""

    def __init__(self) -> None:
        self._stamps: dict[str, array[int]] = {}  # by camera

    def __len__(self) -> int:
        return sum(map(len, self._stamps.values()))

    def add(self, entries: Iterable[FrameEntry]) -> None:
        """Note that these frames have left."""
        for entry in entries:
            self._stamps.setdefault(entry.camera_id, array("q")).append(entry.stamp_ns)

    def stamps(self, camera_id: str | None = None) -> set[int]:
        """Of one camera, or (None) of all."""
        if camera_id is not None:
            return set(self._stamps.get(camera_id, ()))
        return set().union(*self._stamps.values())


def pair_poses(
    poses: CorrectedPoses,
    entries: Sequence[FrameEntry],
    frozen: FrozenFrames,
    old_pose: Callable[[FrameEntry], Float64],
) -> list[PosePair]:
    """Old and new poses of the given frames that are in the history; those that have left it are reported in the log.

    Args:
        poses: As given.
        entries: The history.
        frozen: Frames that have left it.
        old_pose: Where a frame is before the correction, T_world_camera (4, 4).

    Raises:
        MapError: a stamp is of no frame that was ever mapped, or no given frame is in the history.
        PoseError: a pose is not a rigid transform.
    """
    pairs: list[PosePair] = []
    missing: list[tuple[str | None, int, str]] = []
    by_stamp: dict[int, list[FrameEntry]] = {}
    for entry in entries:
        by_stamp.setdefault(entry.stamp_ns, []).append(entry)
    for key, new in poses.items():
        camera_id, stamp_ns = key if isinstance(key, tuple) else (None, key)
        where = f"corrected pose of stamp {stamp_ns}" + ("" if camera_id is None else f" of camera '{camera_id}'")
        check_pose(new, where)
        found = [e for e in by_stamp.get(stamp_ns, ()) if camera_id in (None, e.camera_id)]
        if len({e.camera_id for e in found}) > 1:
            names = ", ".join(sorted({e.camera_id for e in found}))
            raise MapError(f"{where}: cameras {names} have this stamp; give (camera_id, stamp_ns)")
        if found:
            pairs.append(PosePair(found[-1].camera_id, stamp_ns, old_pose(found[-1]), new.copy(), found[-1].world))
        else:
            missing.append((camera_id, stamp_ns, where))
    _check_have_left(missing, frozen, list(by_stamp))
    if missing:
        _log.warning("correction_is_partial", given=len(poses), frozen=len(missing), reason="frames left the history")
    if not pairs:
        reason = f"all {len(missing)} frames given have left the history; raise history.max_frames or max_disk_mb"
        raise MapError(f"no pose to correct: {reason if missing else 'none was given'}")
    return pairs


def _check_have_left(missing: list[tuple[str | None, int, str]], frozen: FrozenFrames, stamps: list[int]) -> None:
    """Refuse stamps that are of no frame, now or ever."""
    left = {camera_id: frozen.stamps(camera_id) for camera_id in {camera_id for camera_id, _, _ in missing}}
    for camera_id, stamp_ns, where in missing:
        if stamp_ns not in left[camera_id]:
            raise MapError(f"{where}: no frame with this stamp was mapped{_nearest(stamp_ns, stamps)}")


def _nearest(stamp_ns: int, stamps: list[int]) -> str:
    if not stamps:
        return "; the history is empty"
    nearest = min(stamps, key=lambda s: abs(s - stamp_ns))
    return f"; of those in the history the nearest is {nearest}, {abs(nearest - stamp_ns) / 1e6:g} ms away"
