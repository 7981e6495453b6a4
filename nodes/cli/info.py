"""``semantic-mapper info``: what a log, a saved map or a file of weights holds, and which weights a mapper uses."""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from msgspec import to_builtins
from rich.table import Table

from semantic_mapper.client import MapClient
from semantic_mapper.config import to_plain
from semantic_mapper.mapping.map_file import describe_map
from semantic_mapper.mapping.map_types import length_unit, voxel_size_text
from semantic_mapper.nodes.cli.query import answer, answer_table
from semantic_mapper.nodes.cli.verb import EXIT_FAILED, JsonOutput, Remote, complete_launch, verb
from semantic_mapper.nodes.console import Output, frame_progress, table
from semantic_mapper.nodes.launcher.running import LaunchView
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.autolabel_note import read_note
from semantic_mapper.replay.log.missing_frames import find_missing_frames, missing_frames_text
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.replay.run_folder import is_map, map_path
from semantic_mapper.transport.launches import STATUS_SOCKET, is_running_mapper, socket_in_launch
from semantic_mapper.transport.messages import SCALE_UNKNOWN
from semantic_mapper.transport.sockets import NewestSubscriber


@verb
def info(
    output: JsonOutput,
    # log (.mcap), its parts or their folder; saved map, or a folder with one; weights (.safetensors); `live`,
    # ipc://PATH or tcp://HOST:PORT of a mapper
    file: Annotated[list[str], typer.Argument(autocompletion=complete_launch)],
    remote: Remote,
) -> int:
    """Say what a log, a map or weights hold.

    Of a log (topics, frames, cameras, duration, missing frames, damage) it reads every message, so that damage
    anywhere is found; exit code 1 where there is any. Of a map (frames, size, blocks, classes) it reads what the file
    says of itself, which is quick however large the map is. Of a running mapper: what its map holds, its nodes (as
    `view --status`, on this machine), and what became of weights that it was offered.

    Example: semantic-mapper info kitchen.mcap
    Example: semantic-mapper info runs/demo
    Example: semantic-mapper info live
    """
    path, live = Path(file[0]), is_running_mapper(file[0])
    remote.refuse_unless(live)
    if path.suffix == ".safetensors":
        found = _weights_file_info(output, path)
    elif live:
        found = _live_info(output, file[0], remote)
    elif is_map(path):
        if len(file) > 1:
            raise typer.BadParameter("one map at a time")
        found = _describe_map(map_path(path))
        output.print(_map_table(found))
    else:
        with frame_progress("read", None, unit="messages") as bar:
            found = describe_log([Path(name) for name in file], bar.advance)
        output.print(_log_table(found))
        _print_damage(output, found)
    output.json(found)
    return EXIT_FAILED if found.get("damage") else 0


def _print_damage(output: Output, found: dict[str, Any]) -> None:
    for notice in found["notices"]:
        output.print(f"note: {notice}")
    output.lines([f"damaged: {damage}" for damage in found["damage"]])
    if found["damage"] or not found["finished"]:
        log = Path(found["parts"][0])  # parts are recovered one by one
        output.print(f"`semantic-mapper import {log} {log.with_stem(log.stem + '-recovered')}` makes a clean log of it")


def describe_log(paths: Sequence[Path], on_message: Callable[[], None]) -> dict[str, Any]:
    """Read all messages of a log (or of the parts of one) and say what is in it."""
    topics, sizes, kinds = Counter[str](), Counter[str](), Counter[str]()
    stamps: dict[str, list[int]] = {}  # of frames, by camera; seqs likewise
    seqs: dict[str, list[int]] = {}
    with open_log(paths, allow_empty=True) as log:
        files = log.paths
        part = None if len(files) > 1 else log.part
        for envelope, parts in log.messages():
            topic = f"{envelope.topic}/{envelope.source}" if envelope.topic != "info" else "info"
            topics[topic] += 1
            sizes[topic] += sum(len(p) for p in parts)
            if envelope.topic == "frame":
                stamps.setdefault(envelope.source, []).append(envelope.stamp_ns)
                seqs.setdefault(envelope.source, []).append(envelope.seq)
                kinds["computed depth"] += envelope.has_computed_depth
                kinds["depth"] += envelope.has_depth and not envelope.has_computed_depth
                kinds["pseudo labels"] += envelope.has_pseudo_label
                kinds["labels"] += envelope.has_label and not envelope.has_pseudo_label
            on_message()
        stream, attachments = log.info, log.attachments()
        damage, notices, finished = [str(e) for e in log.errors], list(log.notices), log.finished
    frames = sum(map(len, stamps.values()))
    seconds = (max(map(max, stamps.values())) - min(map(min, stamps.values()))) / 1e9 if stamps else 0.0
    labels, note = stream.label_set, read_note(attachments)
    return {
        "log": str(paths[0]),
        "parts": [str(file) for file in files],
        "part": None if part is None else part.part,
        "source": stream.source,
        "size_bytes": sum(file.stat().st_size for file in files),
        "frames": frames,
        "frames_with_depth": kinds["depth"],
        "frames_with_labels": kinds["labels"],
        "frames_with_computed_depth": kinds["computed depth"],
        "frames_with_pseudo_labels": kinds["pseudo labels"],
        "duration_s": round(seconds, 3),
        "frame_hz": round((frames - 1) / seconds, 2) if seconds > 0 else None,
        "cameras": {
            name: {"width": k.width, "height": k.height, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy}
            for name, k in stream.cameras.items()
        },
        "missing_frames": {name: find_missing_frames(seqs[name], stamps[name]) for name in sorted(stamps)},
        "label_set": None if labels is None else {"name": labels.name, "classes": list(labels.names)},
        "topics": {name: {"messages": count, "bytes": sizes[name]} for name, count in sorted(topics.items())},
        "metadata": dict(stream.metadata),
        "attachments": {name: len(kept.data) for name, kept in attachments.items()},
        "finished": finished,
        "notices": notices,
        "damage": damage,
        "autolabel": None if note is None else note.plain(),
    }


def autolabel_rows(note: dict[str, Any]) -> list[tuple[str, str]]:
    """Who has rendered pseudo labels, for people: names and texts of rows of ``AutolabelNote.plain``."""
    by, frames = f"{note['weights']} ({note['kind']}, SHA-256 {note['digest'][:16]})", counted(note["frames"], "frame")
    counts = [f"{note['labelled']} of {frames} labelled"]
    for key, text in (("labelled_pixels", "of the pixels"), ("mean_confidence", "mean confidence")):
        counts += [f"{text} {note[key] * 100:.1f} %"] if note[key] is not None else []
    texts = {"kept": "labels kept", "replaced": "labels replaced", "unlabelled": "left without a label"}
    for key, text in (texts | {"depth_written": "depth images computed"}).items():
        counts += [f"{note[key]} {text}"] if note[key] else []
    return [("pseudo labels by", by), ("pseudo labels", "; ".join(counts))]


def _log_table(found: dict[str, Any]) -> Table:
    held = [f"{found['frames_with_depth']} with depth", f"{found['frames_with_labels']} with labels"]
    for key, what in (("frames_with_computed_depth", "computed depth"), ("frames_with_pseudo_labels", "pseudo labels")):
        held += [f"{found[key]} with {what}"] if found[key] else []
    rate = f", {found['frame_hz']:g} Hz" if found["frame_hz"] else ""
    labels, damages = found["label_set"], len(found["damage"])
    parts = ", ".join(Path(part).name for part in found["parts"])
    rows = [
        ("source", found["source"]),
        ("size", f"{found['size_bytes'] / 1e6:.1f} MB"),
        ("parts", parts if found["part"] is None else f"{parts}, part {found['part']} of a recording"),
        ("frames", f"{found['frames']} ({', '.join(held)})"),
        *(autolabel_rows(found["autolabel"]) if found["autolabel"] is not None else ()),
        ("duration", f"{found['duration_s']:g} s{rate}"),
        *(
            (f"camera {name}", f"{k['width']}x{k['height']}, fx {k['fx']:.1f} fy {k['fy']:.1f}")
            for name, k in found["cameras"].items()
        ),
        *((f"missing frames {name}", missing_frames_text(m)) for name, m in found["missing_frames"].items()),
        ("classes", "none" if labels is None else f"{labels['name']}: {', '.join(labels['classes'])}"),
        *found["metadata"].items(),
        *((f"file {name}", counted(size, "byte")) for name, size in found["attachments"].items()),
        *(
            (f"topic {name}", f"{counted(topic['messages'], 'message')}, {topic['bytes'] / 1e6:.1f} MB")
            for name, topic in found["topics"].items()
        ),
        ("damage", counted(damages, "place") if damages else "none"),
    ]
    return table(rows, title=found["log"])


def _describe_map(path: Path) -> dict[str, Any]:
    """What a map's manifest says; its blocks are not read."""
    manifest = describe_map(path)
    labels = manifest.label_set
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
        "label_set": {"name": labels.name, "ids": list(labels.ids), "classes": list(labels.names)},
        "places": 0 if manifest.places is None else manifest.places.places,
        "config": to_plain(manifest.config),
    }


def _map_table(found: dict[str, Any]) -> Table:
    known = found["scale"] != SCALE_UNKNOWN
    rows = [
        ("format", f"voxel map, version {found['format_version']}"),
        ("size", f"{found['size_bytes'] / 1e6:.1f} MB"),
        ("frames", f"{found['frames']}, the last one at {found['last_stamp_ns'] / 1e9:.3f} s"),
        ("scale", found["scale"]),
        ("voxels", voxel_size_text(found["voxel_size_m"], known)),
    ]
    if found["bounds_m"] is not None:
        low, high = found["bounds_m"]
        extent = " x ".join(f"{b - a:.2f}" for a, b in zip(low, high, strict=True))
        rows += [("extent", f"{extent} {length_unit(known)}, from {', '.join(f'{x:.2f}' for x in low)}")]
    rows += [
        ("blocks", f"{found['blocks']:,} of 8 x 8 x 8 voxels"),
        ("measured", f"{found['measured_voxels']:,} voxels, {found['voted_voxels']:,} with class votes"),
        ("places", f"{found['places']} views with features"),
        ("classes", f"{found['label_set']['name']}: {', '.join(found['label_set']['classes'])}"),
    ]
    return table(rows, title=found["map"])


def _live_info(output: Output, place: str, remote: Remote) -> dict[str, Any]:
    """The map and the weights of a mapper that runs; and the nodes, where its launch runs on this machine."""
    with MapClient(place, server=remote.server, keys=remote.keys) as client:
        weights, about = client.weights(), answer(client, "info")
    found = {"mapper": place, "info": about, "weights": to_builtins(weights)}
    output.print(answer_table({"map": place, **about}))
    if "://" not in place:
        with NewestSubscriber(socket_in_launch(place, STATUS_SOCKET), ("status",)) as statuses:
            launch = LaunchView.whole(statuses)
        found |= launch.to_json()
        output.print(launch.table())
    rows = [
        (
            *(v.version, v.state, v.keyframes or "", v.digest[:12]),
            *(f"{score * 100:.1f} %" if v.version else "" for score in (v.score, v.parent_score)),
            v.reason,
        )
        for v in weights.versions
    ]
    names = ("weights", "state", "keyframes", "file", "mIoU held out", "of those before", "reason")
    counts = f"accepted: {weights.taken}, refused: {weights.refused}"
    output.print(table(rows, names, title=f"weights {weights.in_use} in use; {counts}"))
    return found


def _weights_file_info(output: Output, path: Path) -> dict[str, Any]:
    from semantic_mapper.fields.weights import open_weights, refusing_damage, unpack_label_set

    _, metadata = open_weights(path)
    with refusing_damage(path):
        labels, recipe = unpack_label_set(metadata["label_set"]), dict(json.loads(metadata["recipe"]))
    found = {
        "weights": str(path),
        "kind": metadata["field"],
        "size_bytes": path.stat().st_size,
        "label_set": {"name": labels.name, "ids": list(labels.ids), "classes": list(labels.names)},
        "train_frames": len(recipe.get("train_stamps_ns", ())),
        "recipe": recipe,
    }
    named = {"made by": "kind", "steps": "steps", "seconds": "seconds", "version": "version", "suite": "suite"}
    rows = [
        ("kind", found["kind"]),
        ("size", f"{found['size_bytes'] / 1e6:.1f} MB"),
        ("classes", f"{labels.name}: {', '.join(labels.names)}"),
        ("keyframes", found["train_frames"] or "none of a log"),
        *((name, recipe[key]) for name, key in named.items() if key in recipe),
    ]
    for name, key in (("accuracy held out", "held_out_accuracy"), ("mIoU of validation", "validation_miou")):
        rows += [(name, f"{recipe[key] * 100:.1f} %")] if recipe.get(key) is not None else []
    output.print(table(rows, title=str(path)))
    return found
