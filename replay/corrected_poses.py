"""Corrected poses of a log's frames, from a trajectory file, into the map of a session."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import pose_matrix
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.map_types import ALWAYS
from semantic_mapper.replay.importers.tum import match_nearest, read_trajectory
from semantic_mapper.types import Float64

if TYPE_CHECKING:
    from semantic_mapper.replay.session import MapSession

MATCH_NS = 5_000_000  # trajectories are written with microseconds, or with the stamp of another picture of the rig
_PORTION = 8  # frames

_log = get_logger(__name__)


class Trajectory(NamedTuple):
    """Corrected poses in order of time."""

    path: Path  # where they come from
    stamps_ns: NDArray[np.int64]  # (N,)
    poses: Float64  # (N, 4, 4) T_world_camera


def read_corrections(path: Path) -> Trajectory:
    """Read a trajectory in TUM's format, ``stamp tx ty tz qx qy qz qw``: the poses of the camera, stamps in seconds.

    Raises ImportSourceError: missing, empty, or with an invalid line.
    """
    stamps_ns, rows, left_out = read_trajectory(path)
    if left_out:  # a recording can do without a frame; who corrects poses wants all of them
        raise ImportSourceError(f"{left_out[0]} ({len(left_out)} lines); fix or remove them")
    return Trajectory(path, stamps_ns, np.array([pose_matrix(row[:3], row[3:]) for row in rows]))


def keeping_frames(config: MapperConfig, frames: int) -> MapperConfig:
    """The config with a history that holds a log of this many frames, where it says nothing else."""
    if config.history.max_frames:
        return config
    history = msgspec.structs.replace(config.history, max_frames=frames + 1)  # none will leave
    return msgspec.structs.replace(config, history=history)


def match_frames(
    keys: Iterable[tuple[str, int]], stamps_ns: NDArray[np.int64], poses: Float64, within_ns: int
) -> dict[tuple[str, int], Float64]:
    """Poses (N, 4, 4) by the frames, ``keys`` (camera_id, stamp_ns) of one camera, that were taken nearest to their
    stamps (N,), ``within_ns`` at most; those without one are left out."""
    rising = sorted(keys, key=lambda key: key[1])
    stamps = np.array([stamp_ns for _, stamp_ns in rising], np.int64)
    frame_of = match_nearest(stamps_ns, stamps, within_ns) if rising else [-1] * len(stamps_ns)
    return {rising[i]: pose for i, pose in zip(frame_of, poses, strict=True) if i >= 0}


def correct_session(session: MapSession, trajectory: Trajectory) -> int:
    """Move the map to the corrected poses; frames between and after them move along. Returns how many poses were used.

    Poses that no frame of the history was taken within 5 ms of are left out and counted in the log. Raises
    ImportSourceError: that is true of all of them, or the session has frames of several cameras. MapError: the map
    cannot be corrected.
    """
    keys = sorted(session.pipeline.corrector.poses(), key=lambda key: key[1])
    cameras = sorted({camera_id for camera_id, _ in keys})
    if len(cameras) > 1:
        raise ImportSourceError(f"{trajectory.path}: is the way of one camera, and this log has {', '.join(cameras)}")
    poses, given = match_frames(keys, *trajectory[1:], MATCH_NS), len(trajectory.stamps_ns)
    frozen = session.pipeline.corrector.status.frozen  # frames that have left the history, whose stamps are not known
    if not poses:
        first, frames = trajectory.stamps_ns[0] / 1e9, keys[0][1] / 1e9 if keys else math.nan
        raise ImportSourceError(
            f"{trajectory.path}: none of its {given} stamps is that of a mapped frame (within {MATCH_NS / 1e6:g} ms); "
            f"the first is {first:.6f} s, that of the frames {frames:.6f} s; {frozen} frames have left the history "
            "(history.max_frames, max_disk_mb)"
        )
    if len(poses) < given:
        _log.warning("corrections_without_a_frame", left_out=given - len(poses), used=len(poses), frozen=frozen)
    poses = session.odometry_sessions.in_map(poses)
    session.pipeline.corrector.start(poses, until_ns=ALWAYS)  # the whole log was recorded in the old world
    while session.pipeline.corrector.advance(_PORTION):
        pass
    session.follow_correction()
    return len(poses)
