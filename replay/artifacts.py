"""What a session leaves behind: map.npz, map.ply, summary.json, overview.png, report.html."""

import json
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from importlib import metadata
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from semantic_mapper import __version__
from semantic_mapper.config import to_plain
from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.evaluation.metrics import confusion_of
from semantic_mapper.evaluation.upright import camera_up
from semantic_mapper.files import write_json
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.formats import write_ply
from semantic_mapper.mapping.map_file import CHUNK_BLOCKS
from semantic_mapper.mapping.map_types import MapPoints, computed_fraction, scale_name, voxel_size_text
from semantic_mapper.mapping.open3d_loader import open3d_version
from semantic_mapper.mapping.picture_check import SENTENCES
from semantic_mapper.plots import write_picture
from semantic_mapper.queries.objects import remember
from semantic_mapper.queries.revisit import MapVisit
from semantic_mapper.replay.overview import ViewStrip, draw_overview, draw_strip
from semantic_mapper.replay.page import Section, picture, point_view, table_of, write_page
from semantic_mapper.replay.run_folder import MAP_NAME
from semantic_mapper.replay.session import MAX_LISTED, LatencyHistogram, MapSession
from semantic_mapper.replay.summary import SUMMARY_FILE, describe_depth, notes, percent, summary_table
from semantic_mapper.types import Float64, UInt8

_log = get_logger(__name__)

OVERVIEW_FRAMES = 2
# Surface points that a map has at least for each of its blocks, else it is nearly empty. With sensor depth they are 25
# to 33 in the demo, 64 where a flat surface goes through each; with rendered depth that does not agree 0 to 1.
MIN_POINTS_A_BLOCK = 2
OVERVIEW_NAME, REPORT_NAME = "overview.png", "report.html"
STRIPS = 4  # frames that the report shows
PACKAGES = ("torch", "openvino", "numpy", "opencv-contrib-python-headless", "pyzmq", "msgpack", "mcap")


def finish_session(
    session: MapSession,
    out: Path,
    stopped_by: str = "",
    restarted: str = "",
    progress: Callable[[], object] = lambda: None,
    before: MapVisit | None = None,
) -> dict[str, Any]:
    """Map what still waits, and write everything to ``out`` (made if missing): the map first, then the summary,
    pictures and the report last. Returns the summary.

    Each file is there whole or not at all, whenever the process is killed; what an earlier run left is removed first,
    but for its map. A summary that is there means that the map next to it is whole, and the one that it is of. Raises
    MapError: the map cannot be written. ConfigError: the report cannot be written.

    ``stopped_by`` says what ended it early, ``restarted`` what became of the map of a process before this one, which
    the session does not count; empty = nothing. ``progress`` is called after each step. ``before`` is the map that the
    session went on in.
    """
    try:
        session.process_rest()
    except SemanticMapperError as error:  # the map is full, for one: what is in it is worth keeping
        _log.error("last_frames_not_mapped", reason=str(error))
    session.pipeline.release()
    progress()
    out.mkdir(parents=True, exist_ok=True)
    clear_results(out)
    voxel_map = session.pipeline.voxel_map
    try:
        graph = remember(voxel_map, before)
    except SemanticMapperError as error:  # the map itself is saved all the same
        _log.error("objects_not_remembered", reason=str(error))
        graph = None
    progress()
    voxel_map.save(out / MAP_NAME, progress)
    points = voxel_map.points()
    progress()
    write_ply(out / "map.ply", points, session.pipeline.label_set, scale_known=voxel_map.scale_known)
    progress()
    summary = {**_summarize(session, points), **session.more_summary()}
    summary |= {"stopped_by": stopped_by or None, "restarted": restarted or None}
    if summary["map"]["nearly_empty"]:
        _log.warning("map_nearly_empty", reason=summary["map"]["nearly_empty"])
    elif session.range_warning:
        _log.warning("depth_out_of_range", reason=session.range_warning)
    write_json(out / SUMMARY_FILE, summary)
    progress()
    unit = "m" if voxel_map.scale_known else "units"
    poses = [snapshot.T_world_camera for snapshot in session.snapshots]
    up = camera_up(np.stack(poses)) if poses else None
    size = f"voxels of {voxel_size_text(voxel_map.config.voxel_size_m, voxel_map.scale_known)}"
    overview = draw_overview(
        list(_view_strips(session, OVERVIEW_FRAMES)),
        points,
        session.pipeline.label_set,
        title=f"{session.source or 'session'}: {session.fused} frames, {len(points.xyz):,} surface points, {size}",
        subtitle="; ".join(_subtitles(session, summary)),
        up=up,
        unit=unit,
        rooms=[(f"room {room.id}: {room.area_m2:.0f} m²", room.outline, room.center) for room in graph.rooms]
        if graph
        else (),
    )
    write_picture(out / OVERVIEW_NAME, overview)
    if session.rerun is not None:
        progress()
        session.rerun.finish(points, graph)
    progress()
    _write_report(session, points, overview, up, unit, summary, out)
    progress()
    return summary


def result_steps(session: MapSession) -> int:
    """About how often ``finish_session`` calls ``progress``."""
    return 7 + (session.rerun is not None) + ceil(session.pipeline.voxel_map.block_count / CHUNK_BLOCKS)


def clear_results(out: Path) -> None:
    """Remove what an earlier run left next to its map: next to a new map, it would be of another one."""
    for name in (SUMMARY_FILE, "map.ply", OVERVIEW_NAME, REPORT_NAME, "eval.json", "eval.html"):
        (out / name).unlink(missing_ok=True)


def _subtitles(session: MapSession, summary: Mapping[str, Any]) -> Iterator[str]:
    """What is to be known of a picture of the map: what is wrong, its score, and where depth comes from."""
    if summary["pose_check"]["warning"]:
        yield "POSES CANNOT BE TRUSTED (see summary.json)"
    if summary["map"]["nearly_empty"]:
        yield "MAP NEARLY EMPTY (see summary.json)"
    if summary["depth"]["range_warning"]:
        yield "DEPTH OUT OF RANGE (see summary.json)"
    if summary["pictures"]["unlike_training_warning"]:
        yield "PICTURES UNLIKE THOSE OF THE TRAINING: CLASSES CANNOT BE TRUSTED"
    if (miou := summary["metrics"]["miou"]) is not None:
        yield f"mIoU {percent(miou)} over {session.scored} labelled frames that the weights have not seen"
    else:
        yield "no score: its labels are pseudo labels" if session.pseudo_labelled else "no labels to score against"
    if summary["depth"]["source"] != "sensor":
        yield f"depth: {describe_depth(summary['depth'])}"


def _view_strips(session: MapSession, count: int) -> Iterator[ViewStrip]:
    """Frames of a session with what was rendered for them, at most ``count``, evenly spread."""
    kept = session.snapshots
    for index in np.linspace(0, len(kept) - 1, min(count, len(kept))).round().astype(int):
        frame, update = kept[index].open()
        truth = None
        if session.truth is not None and frame.label is not None:
            truth = session.truth.to_map_ids(frame.label, f"frame seq={frame.seq}")
        yield ViewStrip(f"frame {frame.seq}", frame.rgb, update.label, truth, update.depth_m, frame.depth_m is None)


def _nearly_empty(session: MapSession, points: int) -> str | None:
    """Why a map of this many surface points has hardly any for the space that its frames measured, and what to do; None
    where it has, or where no frame had depth to map."""
    blocks = session.pipeline.voxel_map.block_count
    # A camera that stands still fuses nothing, nor does one that sees only what is too far.
    mapped = max(session.fused, session.computed_depth, session.too_far)
    if not mapped or (points and points >= MIN_POINTS_A_BLOCK * blocks):
        return None
    why = (
        "their depth does not agree from frame to frame: check depth_scale, the intrinsics and the poses "
        "(T_world_camera, metres, stamped with the time of capture)"
    )
    if warning := session.pipeline.pose_check.warning or session.range_warning:
        why = warning
    elif 2 * session.without_depth >= mapped:
        why = (
            f"{session.without_depth} of them have no sensor depth, and depth that the field renders does not agree "
            "from frame to frame: record or import depth images, too; or have depth computed from the pictures "
            '(depth.source = "auto")'
        )
    elif 2 * session.computed_depth >= mapped:
        why = (
            f"depth computed from their pictures is missing ({session.too_little_motion} frames moved too little), too "
            "unsure, or does not agree from frame to frame: move the camera sideways, half a metre or more in all, "
            "with views that overlap; it needs exact poses (T_world_camera, metres, stamped with the time of capture), "
            "rectified, sharp images and surfaces with texture"
        )
    return f"the map is nearly empty: {points:,} surface points in {blocks:,} blocks, of {mapped} frames; {why}"


def _summarize(session: MapSession, points: MapPoints) -> dict[str, Any]:
    pipeline, mapper = session.pipeline, session.mapper
    voxel_map, label_set, poses = pipeline.voxel_map, pipeline.label_set, pipeline.pose_check
    domain = pipeline.domain_check
    refusals = sorted(session.refusals.first + session.label_refusals.first, key=lambda r: r.seq)
    return {
        "source": session.source,
        "frames": {
            "published": session.published,
            "fused": session.fused,
            "dropped": session.dropped,
            "refused": len(session.refusals),
            "labels_refused": len(session.label_refusals),
            "scored": session.scored,
            "without_depth": session.without_depth,
            "excluded_from_scores": session.excluded,
            "pseudo_labels": session.pseudo_labelled,
            "left_out": session.left_out,
        },
        "latency_ms": {**_percentiles(session.step_ms), "first": _rounded(session.step_ms.first)},
        "stages_ms": {name: _percentiles(times) for name, times in session.stage_ms.items()},
        "depth": _depth_source(session),
        "scale": scale_name(voxel_map.scale_known),
        "scale_from": (voxel_map.scale_known and session.scale_from) or None,
        "pose_check": {
            "keyframes_compared": poses.compared,
            "depth_disagreement": _rounded(poses.recent, 4),
            "worst_depth_disagreement": _rounded(poses.worst, 4),
            "contradicting_pairs": _rounded(poses.contradicting, 4),
            "worst_contradicting_pairs": _rounded(poses.worst_contradicting, 4),
            "warning": poses.warning or None,
        },
        "pictures": {
            "checked": pipeline.picture_check.checked,
            **{name: pipeline.picture_check.counters[name] for name in SENTENCES},
            "notes": pipeline.picture_check.notes,
            "unlike_training": round(domain.unlike / domain.pictures, 4) if domain and domain.pictures else None,
            "unlike_training_warning": (domain.warning or None) if domain else None,
        },
        "map": {
            "voxel_size_m": voxel_map.config.voxel_size_m,
            "blocks": voxel_map.block_count,
            "surface_points": len(points.xyz),
            "cleared_voxels": voxel_map.cleared,
            "moving_pixels": pipeline.moving.pixels,
            "moving_warning": session.moving_warning or None,
            "unknown": round(float((points.label == label_set.ignore_id).mean()), 4) if len(points.xyz) else None,
            "computed": round(computed_fraction(points), 4) if len(points.xyz) else None,
            "memory_mb": round(voxel_map.memory_bytes / 1e6, 1),
            "corrected_poses": session.corrected_poses,
            "nearly_empty": _nearly_empty(session, len(points.xyz)),
            "unfinished_correction": session.unfinished_correction or None,
        },
        "metrics": _metrics(session, points),
        "metrics_per_image": asdict(session.per_image.metrics()) if session.scored else None,
        "labels": {str(i): name for i, name in zip(label_set.ids, label_set.names, strict=True)},
        "label_set": {
            "name": label_set.name,
            "ignore_id": label_set.ignore_id,
            "colors": {str(i): list(c) for i, c in zip(label_set.ids, label_set.colors, strict=True)},
            "scored_classes": list(session.truth.shared) if session.truth is not None else None,
        },
        "field": {
            "name": mapper.weights.kind,
            "renderer": type(pipeline.field).__name__,
            "sampling": pipeline.config.sampling.mode,
            "anchors": len(mapper.weights.anchors),
        },
        "weights": {
            "file": mapper.weights_path.name,
            "recipe": mapper.weights.recipe.get("kind", "unknown"),
            "finetuned_frames": len(mapper.weights.train_stamps_ns),
            "learned": session.learned,
        },
        "seed": pipeline.config.seed,
        "quality": pipeline.config.quality,
        "config": to_plain(pipeline.config),  # as it was in force: with what the quality sets
        "refusals": [{"seq": r.seq, "stamp_ns": r.stamp_ns, "reason": r.reason} for r in refusals[:MAX_LISTED]],
        "damaged_stretches": session.damages.first,
        "versions": versions(),
    }


def _depth_source(session: MapSession) -> dict[str, Any]:
    """Where the geometry comes from: the sensor, the pictures of a moving camera, or renders of the field."""
    mapped = session.published - session.dropped - len(session.refusals)
    rendered, computed = (n / mapped if mapped else 0.0 for n in (session.without_depth, session.computed_depth))
    names = {"sensor": rendered + computed < 1, "rendered": rendered > 0, "computed": computed > 0}
    given_px, refined_px = (_rounded(px, 2) for px in session.pipeline.frame_depth.disagreement_px or (None, None))
    sources = [name for name, used in names.items() if used]
    return {
        "source": sources[0] if len(sources) == 1 else "mixed" if sources else "sensor",
        "rendered_fraction": round(rendered, 4),
        "computed_fraction": round(computed, 4),
        "too_little_motion": session.too_little_motion,
        "too_far_fraction": round(session.too_far / session.with_depth, 4) if session.with_depth else None,
        "computed_too_far": bool(session.range_warning and computed),
        "range_warning": session.range_warning or None,
        "given_poses_off_px": given_px,
        "refined_poses_off_px": refined_px,
    }


def _metrics(session: MapSession, points: MapPoints) -> dict[str, Any]:
    scores = asdict(session.confusion.metrics())
    if not session.scored:
        return {**dict.fromkeys(scores), "map_miou": None}
    truth = session.surface_truth.labels_at(points.xyz)
    surface = confusion_of(truth, points.label, session.pipeline.label_set, "map")
    return {**scores, "map_miou": surface.metrics().miou}


def _percentiles(times: LatencyHistogram) -> dict[str, float | None]:
    """Median and 95th percentile, null for nothing."""
    return {"p50": _rounded(times.percentile(50)), "p95": _rounded(times.percentile(95))}


def _rounded(value: float | None, digits: int = 2) -> float | None:
    return None if value is None else round(value, digits)


def versions() -> dict[str, str]:
    """Versions of this project, Python and the packages that decide a result."""
    found = {"semantic_mapper": __version__, "python": platform.python_version(), "open3d": open3d_version()}
    for name in PACKAGES:
        with suppress(metadata.PackageNotFoundError):  # torch, of which mapping has no need
            found[name] = metadata.version(name)
    return found


def _write_report(
    session: MapSession,
    points: MapPoints,
    overview: UInt8,
    up: Float64 | None,
    unit: str,
    summary: Mapping[str, Any],
    out: Path,
) -> None:
    label_set = session.pipeline.label_set
    caption = "Frames, what was rendered for them, and the map from above and aside"
    strips = [
        picture(draw_strip(s, label_set, unit), f"{s.name}: camera, and what was rendered for it", photo=True)
        for s in _view_strips(session, STRIPS)
    ]
    refused = [(str(r["seq"]), str(r["stamp_ns"]), r["reason"]) for r in summary["refusals"]]
    sections = [
        Section(notes=notes(summary)),
        Section("The map", view=point_view(points, label_set, up) if len(points.xyz) else None),
        Section("Overview", pictures=[picture(overview, caption, photo=True)]),
        Section("Figures", tables=[summary_table({out.resolve().name: summary})]),
        Section("Frames", pictures=strips),
        Section(
            f"Refused and damaged, the first {MAX_LISTED}",
            notes=summary["damaged_stretches"],
            tables=[table_of(("seq", "stamp, ns", "reason"), refused)] if refused else [],
        ),
        Section(
            "Configuration",
            tables=[table_of(("package", "version"), list(summary["versions"].items()))],
            folded={"Settings that were in force": json.dumps(summary["config"], indent=1)},
        ),
    ]
    write_page(out / REPORT_NAME, f"Map of {summary['source'] or 'a session'}", sections)
