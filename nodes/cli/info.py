"""``semantic-mapper info``: what a log, a saved map or a file of boxes holds, and which weights a mapper uses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from msgspec import to_builtins
from rich.box import SIMPLE
from rich.table import Table

from semantic_mapper.client import MapClient, Weights
from semantic_mapper.config import to_plain
from semantic_mapper.errors import ConfigError
from semantic_mapper.mapping.map_file import describe_map
from semantic_mapper.mapping.map_types import length_unit, voxel_size_text
from semantic_mapper.nodes.cli.options import Remote
from semantic_mapper.nodes.cli.verb import EXIT_FAILED, JsonOption, verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.nodes.launcher.running import map_endpoint
from semantic_mapper.plain_text import counted
from semantic_mapper.plots import write_picture
from semantic_mapper.replay.autolabel_note import read_note
from semantic_mapper.replay.box_picture import draw_boxes
from semantic_mapper.replay.boxes import BoxFile, load_boxes, with_times
from semantic_mapper.replay.log.missing_frames import find_missing_frames, missing_frames_text
from semantic_mapper.replay.log.sequence import LogSequence, open_log, read_part
from semantic_mapper.replay.run_folder import is_map, map_path, prepare_file
from semantic_mapper.transport.messages import SCALE_UNKNOWN

BOX_FILES = (".json", ".xml")
LISTED = 10  # damages that are shown one by one
MAX_TOPICS = 256  # counted by name; a log may be made to hold a new one in each message
OTHER_TOPICS = "others"
PICTURES = (".png", ".jpg", ".jpeg")


@verb
def info(
    file: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE...",
            help="Recorded log (.mcap), its parts or their folder; saved map, or a folder with map.npz; boxes.json, "
            "JSON of `query MAP instances`, or XML of KITTI-360; `live`, ipc://PATH or tcp://HOST:PORT of a mapper.",
        ),
    ],
    remote: Remote,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="LOG", help="Draw boxes over the three frames of a log that show most of them."),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="--picture: what to write (.png, .jpg).")] = None,
    json: JsonOption = False,
) -> int:
    """Say what a log, a map or a file of boxes holds, or which weights a mapper uses.

    Of a log (topics, frames, cameras, duration, missing frames, damage) it reads every message, so that damage
    anywhere is found; exit code 1 where there is any. Of a map (frames, size, blocks, classes) it reads what the file
    says of itself, which is quick however large the map is. Of a running mapper it lists the weights that it was
    offered, with what became of them. Boxes are for `finetune --kind panoptic`; any editor changes their file
    (docs/scenes.md).

    Example: semantic-mapper info kitchen.mcap
    Example: semantic-mapper info runs/demo
    Example: semantic-mapper info boxes.json --picture kitchen.mcap --out boxes.png
    Example: semantic-mapper info live
    """
    output = Output.guarded()
    output.quiet = json
    path = Path(file[0])
    boxes = path.suffix.lower() in BOX_FILES
    if (picture is not None or out is not None) and not boxes:
        raise typer.BadParameter("goes with a file of boxes", param_hint="--picture and --out")
    if boxes:
        found = _boxes_info(output, path, picture, out)
    elif endpoint := map_endpoint(file[0]):
        found = _weights_info(output, endpoint, remote)
    elif is_map(path):
        if len(file) > 1:
            raise typer.BadParameter("one map at a time")
        found = map_summary(map_path(path))
        output.print(map_table(found))
    else:
        with frame_progress("read", None, unit="messages") as bar:
            found = describe_log([Path(name) for name in file], bar.advance)
        output.print(info_table(found))
        _print_damage(output, found)
    if json:
        output.json(found)
    return EXIT_FAILED if found.get("damage") else 0


def _print_damage(output: Output, found: dict[str, Any]) -> None:
    for notice in found["notices"]:
        output.print(f"note: {notice}")
    for damage in found["damage"][:LISTED]:
        output.print(f"damaged: {damage}")
    if len(found["damage"]) > LISTED:
        output.print(f"and {len(found['damage']) - LISTED} more")
    if found["damage"] or not found["finished"]:
        log = Path(found["parts"][0])  # parts are recovered one by one
        output.print(f"`semantic-mapper import {log} {log.with_stem(log.stem + '-recovered')}` makes a clean log of it")


def describe_log(paths: Sequence[Path], on_message: Callable[[], None]) -> dict[str, Any]:
    """Read all messages of a log (or of the parts of one) and say what is in it.

    Raises:
        LogError: it cannot be opened.
    """
    topics: Counter[str] = Counter()
    sizes: Counter[str] = Counter()
    stamps: dict[str, list[int]] = {}  # of frames, by camera; seqs likewise
    seqs: dict[str, list[int]] = {}
    depth = labelled = computed = pseudo = 0
    with open_log(paths, allow_empty=True) as log:
        logs = log.logs if isinstance(log, LogSequence) else [log]
        files = [part.path for part in logs]
        part = None if len(logs) > 1 else read_part(logs[0])
        for envelope, parts in log.messages():
            topic = f"{envelope.topic}/{envelope.source}" if envelope.topic != "info" else "info"
            if topic not in topics and len(topics) >= MAX_TOPICS:
                topic = OTHER_TOPICS
            topics[topic] += 1
            sizes[topic] += sum(len(p) for p in parts)
            if envelope.topic == "frame":
                camera = envelope.source if envelope.source in stamps or len(stamps) < MAX_TOPICS else OTHER_TOPICS
                stamps.setdefault(camera, []).append(envelope.stamp_ns)
                seqs.setdefault(camera, []).append(envelope.seq)
                computed += envelope.has_computed_depth
                depth += envelope.has_depth and not envelope.has_computed_depth
                pseudo += envelope.has_pseudo_label
                labelled += envelope.has_label and not envelope.has_pseudo_label
            on_message()
        stream, attachments = log.info, log.attachments()
        damage, notices, finished = [str(e) for e in log.errors], list(log.notices), log.finished
    frames = sum(map(len, stamps.values()))
    seconds = (max(map(max, stamps.values())) - min(map(min, stamps.values()))) / 1e9 if stamps else 0.0
    return {
        "log": str(paths[0]),
        "parts": [str(file) for file in files],
        "part": None if part is None else part.part,
        "source": stream.source,
        "size_bytes": sum(file.stat().st_size for file in files),
        "frames": frames,
        "frames_with_depth": depth,
        "frames_with_labels": labelled,
        "frames_with_computed_depth": computed,
        "frames_with_pseudo_labels": pseudo,
        "duration_s": round(seconds, 3),
        "frame_hz": round((frames - 1) / seconds, 2) if seconds > 0 else None,
        "cameras": {
            name: {"width": k.width, "height": k.height, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy}
            for name, k in stream.cameras.items()
        },
        "missing_frames": {name: find_missing_frames(seqs[name], stamps[name]) for name in sorted(stamps)},
        "label_set": None
        if stream.label_set is None
        else {"name": stream.label_set.name, "classes": list(stream.label_set.names)},
        "topics": {name: {"messages": count, "bytes": sizes[name]} for name, count in sorted(topics.items())},
        "metadata": dict(stream.metadata),
        "attachments": {name: len(kept.data) for name, kept in attachments.items()},
        "finished": finished,
        "notices": notices,
        "damage": damage,
        "autolabel": None if (note := read_note(attachments)) is None else note.plain(),
    }


def autolabel_rows(note: dict[str, Any]) -> list[tuple[str, str]]:
    """Who has rendered pseudo labels, for people: names and texts of rows.

    Args:
        note: As ``AutolabelNote.plain`` gives it.
    """
    confidence = "" if note["mean_confidence"] is None else f", mean confidence {note['mean_confidence'] * 100:.1f} %"
    if note["labelled_pixels"] is not None:
        confidence = f", {note['labelled_pixels'] * 100:.1f} % of the pixels{confidence}"
    frames = counted(note["frames"], "frame")
    counts = [f"{note['labelled']} of {frames} labelled{confidence}"]
    counts += [f"{note[key]} {text}" for key, text in _AUTOLABEL_COUNTS.items() if note[key]]
    settings = [f"--min-confidence {note['min_confidence']:g}"] if note["min_confidence"] else []
    settings += ["--overwrite-labels"] if note["overwrite_labels"] else []
    settings += ["--depth"] if note["depth"] else []
    by = f"{note['weights']} ({note['kind']}, SHA-256 {note['digest'][:16]})"
    by = " ".join([by, *settings])
    return [("pseudo labels by", by), ("pseudo labels", "; ".join(counts))]


_AUTOLABEL_COUNTS = {
    "kept": "labels kept",
    "replaced": "labels replaced",
    "unlabelled": "left without a label",
    "depth_written": "depth images computed or rendered",
}


def info_table(found: dict[str, Any]) -> Table:
    """What ``describe_log`` found, for people."""
    table = Table(title=found["log"], title_justify="left", show_header=False)
    table.add_row("source", found["source"])
    table.add_row("size", f"{found['size_bytes'] / 1e6:.1f} MB")
    if len(found["parts"]) > 1:
        table.add_row("parts", ", ".join(Path(part).name for part in found["parts"]))
    elif found["part"] is not None:
        table.add_row("part", f"{found['part']} of a recording")
    depth, labels = found["frames_with_depth"], found["frames_with_labels"]
    held = [f"{depth} with depth", f"{labels} with labels"]
    for key, what in (("frames_with_computed_depth", "computed depth"), ("frames_with_pseudo_labels", "pseudo labels")):
        held += [f"{found[key]} with {what}"] if found[key] else []
    table.add_row("frames", f"{found['frames']} ({', '.join(held)})")
    if found["autolabel"] is not None:
        for name, text in autolabel_rows(found["autolabel"]):
            table.add_row(name, text)
    rate = f", {found['frame_hz']:g} Hz" if found["frame_hz"] else ""
    table.add_row("duration", f"{found['duration_s']:g} s{rate}")
    for name, k in found["cameras"].items():
        table.add_row(f"camera {name}", f"{k['width']}x{k['height']}, fx {k['fx']:.1f} fy {k['fy']:.1f}")
    for name, missing in found["missing_frames"].items():
        table.add_row(f"missing frames {name}", missing_frames_text(missing))
    label_set = found["label_set"]
    text = "none" if label_set is None else f"{label_set['name']}: {', '.join(label_set['classes'])}"
    table.add_row("classes", text)
    for key, value in found["metadata"].items():
        table.add_row(key, value)
    for name, size in found["attachments"].items():
        table.add_row(f"file {name}", counted(size, "byte"))
    table.add_section()
    for name, topic in found["topics"].items():
        table.add_row(f"topic {name}", f"{counted(topic['messages'], 'message')}, {topic['bytes'] / 1e6:.1f} MB")
    table.add_section()
    count = len(found["damage"])
    table.add_row("damage", counted(count, "place") if count else "none")
    return table


def map_summary(path: Path) -> dict[str, Any]:
    """Read a map's manifest, but not its blocks.

    Raises:
        MapError: no such file, not a map, or damaged where it says this.
    """
    manifest = describe_map(path)
    return {
        "map": str(path),
        "format_version": manifest.version,
        "size_bytes": path.stat().st_size,
        "frames": manifest.frames,
        "scale": manifest.scale,
        "last_stamp_ns": manifest.last_stamp_ns,
        "voxel_size_m": manifest.config.voxel_size_m,
        "bounds_m": None if manifest.bounds_m is None else [list(corner) for corner in manifest.bounds_m],
        "blocks": manifest.blocks,
        "measured_voxels": sum(chunk.measured for chunk in manifest.chunks),
        "voted_voxels": sum(chunk.voted for chunk in manifest.chunks),
        "label_set": {
            "name": manifest.label_set.name,
            "ids": list(manifest.label_set.ids),
            "classes": list(manifest.label_set.names),
        },
        "places": 0 if manifest.places is None else manifest.places.places,
        "config": to_plain(manifest.config),
    }


def map_table(found: dict[str, Any]) -> Table:
    """What ``map_summary`` found, for people."""
    table = Table(title=found["map"], title_justify="left", show_header=False)
    table.add_row("format", f"voxel map, version {found['format_version']}")
    table.add_row("size", f"{found['size_bytes'] / 1e6:.1f} MB")
    table.add_row("frames", f"{found['frames']}, the last one at {found['last_stamp_ns'] / 1e9:.3f} s")
    table.add_row("scale", found["scale"])
    known = found["scale"] != SCALE_UNKNOWN
    unit = length_unit(known)
    table.add_row("voxels", voxel_size_text(found["voxel_size_m"], known))
    bounds = found["bounds_m"]
    if bounds is not None:
        low, high = bounds
        table.add_row("extent", " x ".join(f"{b - a:.2f}" for a, b in zip(low, high, strict=True)) + f" {unit}")
        table.add_row("from", ", ".join(f"{x:.2f}" for x in low) + f" {unit}")
        table.add_row("to", ", ".join(f"{x:.2f}" for x in high) + f" {unit}")
    table.add_row("blocks", f"{found['blocks']:,} of 8 x 8 x 8 voxels")
    table.add_row("measured", f"{found['measured_voxels']:,} voxels, {found['voted_voxels']:,} with class votes")
    places = f"{found['places']} views with features" if found["places"] else "none: nothing to find oneself by"
    table.add_row("places", places)
    label_set = found["label_set"]
    table.add_row("classes", f"{label_set['name']}: {', '.join(label_set['classes'])}")
    return table


def _weights_info(output: Output, endpoint: str, remote: Remote) -> dict[str, Any]:
    """The weights of a running mapper.

    Raises:
        TransportError: nobody answers there.
    """
    with MapClient(endpoint, identity=remote.identity()) as client:
        state = client.weights()
    output.print(_weights_table(state))
    return {
        "in_use": state.in_use,
        "before": state.before,
        "taken": state.taken,
        "refused": state.refused,
        "rolled_back": state.rolled_back,
        "versions": [to_builtins(v) for v in state.versions],
    }


def _weights_table(state: Weights) -> Table:
    """For people."""
    table = Table(
        title=f"weights {state.in_use} in use; {counted(state.taken, 'time')} taken, {state.refused} refused, "
        f"{state.rolled_back} rolled back",
        title_justify="left",
        box=SIMPLE,
    )
    for heading in ("version", "state", "keyframes", "mIoU held out", "of those before", "file", "reason"):
        table.add_column(heading, justify="left" if heading in ("state", "file", "reason") else "right")
    for v in state.versions:
        scores = (f"{v.score * 100:.1f} %", f"{v.parent_score * 100:.1f} %") if v.version else ("", "")
        table.add_row(str(v.version), v.state, str(v.keyframes or ""), *scores, v.digest[:12], v.reason)
    return table


def _boxes_info(output: Output, file: Path, picture: Path | None, out: Path | None) -> dict[str, Any]:
    """List the boxes of a file, or draw them.

    Raises:
        typer.BadParameter: options that do not go together.
        ConfigError: the file cannot be read.
    """
    if (picture is None) is not (out is None):
        raise typer.BadParameter("go together", param_hint="--picture and --out")
    found = load_boxes(file)
    if picture is not None and out is not None:
        if out.suffix.lower() not in PICTURES:
            raise typer.BadParameter(f"a picture ends in {' or '.join(PICTURES)}, got {out}", param_hint="--out")
        if _same_file(out, picture):
            raise typer.BadParameter(f"{out} is the log", param_hint="--out")
        output.print(_draw(found, picture, file, out))
    else:
        output.print(_box_table(str(file), found))
    return _describe_boxes(found)


def _same_file(a: Path, b: Path) -> bool:
    return a == b or (a.exists() and b.exists() and a.samefile(b))


def _draw(found: BoxFile, log_path: Path, file: Path, out: Path) -> str:

    if _same_file(out, file):
        raise ConfigError(f"{out}: is the file of boxes; give the picture another name")
    prepare_file(out)
    with open_log(log_path) as log:
        timed, _ = with_times(found, file, log)
        picture, seen = draw_boxes(log, timed.primitives, f"{file.name} in {log_path.name}")
    write_picture(out, picture)
    count = len(found.primitives)
    hint = "" if seen or not count else "; are they in the log's world frame?"
    return f"{seen} of {counted(count, 'box', 'boxes')} in view of its frames{hint}; written to {out}"


def _describe_boxes(found: BoxFile) -> dict[str, Any]:
    """The boxes as plain data, lengths in metres rounded to tenths of millimetres."""
    listed = [
        {
            "id": box.id,
            "class": box.class_name,
            "shape": box.shape,
            "thing": box.thing,
            "center": np.round(box.T_world_box[:3, 3], 4).tolist(),
            "size": np.round(box.size, 4).tolist(),
            "stamps_ns": [stamp for stamp, _ in box.stamps or ()],
            "frames": [number for number, _ in box.frames or ()],
        }
        for box in found.primitives
    ]
    merge = {name: list(rest) for name, rest in found.merge.items()}
    return {"boxes": listed, "merge": merge, "left_out": found.left_out, "bad": list(found.bad)}


def _box_table(title: str, found: BoxFile) -> Table:
    """The boxes, for people."""
    table = Table(title=title, title_justify="left")
    for name in ("id", "class", "shape", "thing", "centre, m", "size, m", "times"):
        table.add_column(name, overflow="fold")
    for box in _describe_boxes(found)["boxes"]:
        lengths = (" ".join(f"{value:.2f}" for value in box[key]) for key in ("center", "size"))
        thing = "yes" if box["thing"] else "no"
        table.add_row(str(box["id"]), box["class"], box["shape"], thing, *lengths, _span(box))
    if found.left_out:
        table.caption = f"left out: {found.left_out} of no class"
    return table


def _span(box: dict[str, Any]) -> str:
    """When a described box is where it is."""
    times, frames = box["stamps_ns"], box["frames"]
    if times:
        return f"{len(times)}: {times[0]} to {times[-1]} ns"
    return f"{counted(len(frames), 'frame')}: {frames[0]} to {frames[-1]}" if frames else "always"
