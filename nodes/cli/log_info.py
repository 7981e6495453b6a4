"""What a log holds, as plain data and as a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from semantic_mapper.plain_text import counted
from semantic_mapper.replay.autolabel_note import read_note
from semantic_mapper.replay.log.gaps import find_gaps, gaps_text
from semantic_mapper.replay.log.sequence import LogSequence, open_log, read_part

MAX_TOPICS = 256  # counted by name; a log may be made to hold a new one in each message
OTHER_TOPICS = "others"


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
        "gaps": {name: find_gaps(seqs[name], stamps[name]) for name in sorted(stamps)},
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
    if note.get("labelled_pixels") is not None:
        confidence = f", {note['labelled_pixels'] * 100:.1f} % of the pixels{confidence}"
    frames = counted(note["frames"], "frame")
    counts = [f"{note['labelled']} of {frames} labelled{confidence}"]
    counts += [f"{note[key]} {text}" for key, text in _AUTOLABEL_COUNTS.items() if note[key]]
    settings = [f"--min-confidence {note['min_confidence']:g}"] if note["min_confidence"] else []
    settings += ["--overwrite-labels"] if note["overwrite_labels"] else []
    settings += ["--depth"] if note["depth"] else []
    by = f"{note['weights']} ({note['kind']}, SHA-256 {note['digest'][:16]})"
    by = " ".join([by, *settings])
    if not note["classes"]:
        return [("depth by", by), ("depth", f"{note['depth_written']} of {frames} got what was rendered")]
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
    for name, gaps in found["gaps"].items():
        table.add_row(f"gaps {name}", gaps_text(gaps))
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
