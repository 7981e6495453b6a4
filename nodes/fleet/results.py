"""What a task of a fleet has found, as its store keeps it: one JSON document a task, and rows for the tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from semantic_mapper.errors import ConfigError

FORMAT_VERSION = 1


class ClassRow(msgspec.Struct, frozen=True):
    """How well one class was found in a log.

    Args:
        method: What labelled the frames: "replay", or a method of ``eval`` such as "sray" or "own image alone".
        name: Of the class.
        iou: Intersection over union, 0..1.
    """

    method: str
    name: str
    iou: float


class EventRow(msgspec.Struct, frozen=True):
    """Something in a log that a person may want to look at.

    Args:
        kind: "note", "refused" and "damaged" (replay, eval), "unlabelled" (autolabel), "keyframes" (finetune).
        text: What happened.
        seq: Of the frame, -1 where it is of no single frame.
        stamp_ns: Of the frame, 0 where it is of no single frame.
    """

    kind: str
    text: str
    seq: int = -1
    stamp_ns: int = 0


class SegmentRow(msgspec.Struct, frozen=True):
    """Confusion matrix of a stretch of consecutive scored frames, which comparisons draw again.

    Args:
        method: As in ``ClassRow``.
        first: Number of the first scored frame of the stretch.
        frames: How many were scored.
        names: L names of classes.
        counts: L * (L + 1) pixels, row by row: row = truth, column = prediction, the last one = unknown.
    """

    method: str
    first: int
    frames: int
    names: tuple[str, ...]
    counts: tuple[int, ...]


class Findings(msgspec.Struct, frozen=True):
    """What an operation has found in a log: the same for the same input, but for what ``costs`` says.

    Args:
        metrics: Figures by name, such as "miou", "map_miou", "frames_fused"; None where there was nothing to score.
        costs: Seconds and bytes of this run by name, such as "step_ms_p50".
        classes, events, segments: Rows; see there.
        thumbnail: Name of a picture among the files; empty = none.
        report: Name of a page among the files; empty = none.
    """

    metrics: dict[str, float | None]
    costs: dict[str, float | None] = {}
    classes: tuple[ClassRow, ...] = ()
    events: tuple[EventRow, ...] = ()
    segments: tuple[SegmentRow, ...] = ()
    thumbnail: str = ""
    report: str = ""


class ResultFile(msgspec.Struct, frozen=True):
    """A file of a result.

    Args:
        bytes: Its size.
        sha256: Of its content.
    """

    bytes: int
    sha256: str


class TaskResult(msgspec.Struct, frozen=True):
    """``result.json`` of a task; that it is there says that the task is done.

    Args:
        key: Digest of all that decides the result: operation, content of the log, weights, settings, code.
        operation: "replay", "eval", "autolabel", "finetune" or "refine".
        log: URL of the log, without credentials.
        log_digest: Of its content.
        log_bytes: Its size.
        tags: Of the manifest, such as robot, site and date.
        weights: Name of the weights, for people.
        weights_digest: Of their content.
        settings: What ``--set`` said.
        version: Of the code, for people: version and git revision.
        code: Digest of the code.
        findings: What was found.
        files: Size and digest of each file by its name below ``folder``.
        folder: Of the files, below the store: "results/KEY/ATTEMPT".
        attempts: How many it took.
        seconds: Of the attempt, without queueing.
        node: Host that ran it.
        finished_ns: When, nanoseconds since 1970.
    """

    key: str
    operation: str
    log: str
    log_digest: str
    log_bytes: int
    tags: dict[str, str]
    weights: str
    weights_digest: str
    settings: dict[str, Any]
    version: str
    code: str
    findings: Findings
    files: dict[str, ResultFile]
    folder: str
    attempts: int
    seconds: float
    node: str
    finished_ns: int
    format: int = FORMAT_VERSION


class Failure(msgspec.Struct, frozen=True):
    """A quarantined task: it failed twice and is not tried again unless asked for.

    Args:
        key: Digest of operation, URL, weights and settings: no result's key.
        operation, log, tags, version, code: As in ``TaskResult``.
        errors: What each attempt ended with.
        finished_ns: When the last one ended.
    """

    key: str
    operation: str
    log: str
    tags: dict[str, str]
    version: str
    errors: tuple[str, ...]
    finished_ns: int
    code: str = ""
    format: int = FORMAT_VERSION


def encode_document(document: TaskResult | Failure) -> bytes:
    """As JSON, keys in a fixed order."""
    return msgspec.json.format(msgspec.json.encode(document, order="sorted"), indent=1)


def decode_result(data: bytes, where: str) -> TaskResult:
    """``result.json`` read back.

    Raises:
        ConfigError: damaged, or of a newer version.
    """
    return _decode(data, TaskResult, where)


def decode_failure(data: bytes, where: str) -> Failure:
    """``failed/KEY.json`` read back.

    Raises:
        ConfigError: damaged, or of a newer version.
    """
    return _decode(data, Failure, where)


def _decode(data: bytes, kind: type[Any], where: str) -> Any:
    try:
        found = msgspec.json.decode(data, type=kind)
    except msgspec.DecodeError as error:
        raise ConfigError(f"{where}: is damaged ({error}); delete it, and `fleet run` does the task again") from error
    if found.format > FORMAT_VERSION:
        raise ConfigError(f"{where}: is of format {found.format}, this version reads up to {FORMAT_VERSION}; upgrade")
    return found


def without_costs(result: TaskResult) -> Mapping[str, Any]:
    """What is the same however often, wherever and in whatever order a task runs: for comparisons of stores."""
    plain = msgspec.to_builtins(result)
    for name in ("attempts", "seconds", "node", "finished_ns", "folder", "files", "log", "tags", "weights"):
        del plain[name]
    del plain["findings"]["costs"]
    return plain
