"""Where the frames of a log are in a saved map."""

import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from semantic_mapper.localization.relocalizer import NotFound, Relocalizer, Sighting, agreed, find_consensus, sighting
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.types import PosedFrame


def relocalize_frames(
    voxel_map: VoxelMap, log: Log, every: int, count: int, on_frame: Callable[[int], None]
) -> dict[str, Any]:
    """Look for every n-th frame, ``count`` of them; plain data, as of ``query MAP relocalize LOG --json``."""
    finder = Relocalizer(voxel_map.places.places, voxel_map, voxel_map.label_set.ignore_id)
    rows: list[dict[str, Any]] = []
    unreadable: list[dict[str, Any]] = []
    seen: dict[int, list[Sighting]] = {}
    for number, frame in enumerate(log.frames_or_errors(count * every)):
        if number % every:
            continue
        if not isinstance(frame, PosedFrame):
            unreadable.append({"number": number, "reason": str(frame)})
            continue
        of_world = seen.setdefault(frame.world, [])
        began = time.perf_counter()
        depth = None if frame.depth_sigma_m is not None else frame.depth_m
        found = finder.find(frame.rgb, depth, frame.intrinsics)
        row: dict[str, Any] = {"seq": frame.seq, "camera_id": frame.camera_id, "stamp_ns": frame.stamp_ns}
        row |= {"world": frame.world, "ms": round((time.perf_counter() - began) * 1e3, 1), "features": found.inliers}
        if isinstance(found, NotFound):
            row |= {"reason": found.reason, "detail": found.detail}
        else:
            row["T_map_camera"] = found.T_map_camera.tolist()
            of_world.append(sighting(found.T_map_camera, frame.T_world_camera))
        rows.append(row)
        on_frame(len(rows) + len(unreadable))
    sessions: list[dict[str, Any]] = []
    for world, sightings in seen.items():
        consensus = find_consensus(sightings)
        T_map_world = None if consensus.refusal else agreed(consensus.agreeing).tolist()
        sessions.append(
            {"world": world, "found": len(sightings), "agreeing": len(consensus.agreeing)}
            | {"disagreement": consensus.refusal, "T_map_world": T_map_world}
        )
    return {
        "frames": len(rows),
        "found": sum(map(len, seen.values())),
        "refused": dict(Counter(row["reason"] for row in rows if "reason" in row).most_common()),
        "unreadable": unreadable,
        "sessions": sessions,
        "looks": rows,
    }
