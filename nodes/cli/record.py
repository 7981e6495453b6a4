"""``semantic-mapper record``: what a running launch publishes becomes a log."""

import os
import time
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import typer

from semantic_mapper.config import AtLeastZero, convert_config
from semantic_mapper.errors import ConfigError, LogError
from semantic_mapper.nodes.cli.verb import EXIT_FAILED, OverwriteOption, SettingOptions, complete_launch, verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.nodes.launcher.liveness import HeartbeatWriter
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.options import RecorderOptions
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.nodes.recorder.node import Recorder
from semantic_mapper.nodes.recorder.node import record as record_until_end
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.run_folder import prepare_file
from semantic_mapper.transport.launches import launch_folder, read_launch_note

HEAR_S = 10.0  # how long the nodes, which run already, may take to answer


class RecorderSettings(SettingOptions):
    """Those of a recorder node that a person may want to set."""

    kind = RecorderOptions
    options: ClassVar = {
        "--split-mb": "split_mb",
        "--split-s": "split_s",
        "--on-disk-full": "disk_full",
        "--reserve-mb": "reserve_mb",
    }


@verb
def record(
    output: Output,
    log: Path,  # log to write (.mcap); further parts: -1, -2, ...
    recorder: RecorderSettings,
    *,
    # its socket folder, or its file's name; by default the one that runs here
    launch: Annotated[str, typer.Option(autocompletion=complete_launch)] = "",
    source: list[str] | None = None,  # node to record; repeated. By default cameras and mappers
    topic: list[str] | None = None,  # repeated. By default info, frame, refused, status; or map
    duration: AtLeastZero = 0.0,  # seconds; 0 = to the end of the stream, or Ctrl-C
    jpeg: Annotated[int, msgspec.Meta(ge=0, le=100)] = 0,  # quality of colour images; 0 = as they are, lossless
    overwrite: OverwriteOption = False,
) -> int:
    """Record what the nodes of a running launch publish.

    A live launch does not notice. One that plays a log in lockstep or fast waits for this reader, too, and fails where
    it reads nothing for 30 s (lockstep: 300 s). The log keeps the calibration and the launch's settings. Exit code 1
    where something is missing, as where the disk was full; what was written is whole. A launch can also have a
    recorder of its own (`up --set recorder.enabled=true`).

    Example: semantic-mapper record kitchen.mcap --on-disk-full delete-oldest
    """
    prepare_file(log)
    wanted = {"out": str(log), "source_timeout_s": HEAR_S, "overwrite": overwrite, **recorder.table()}
    wanted |= {"topics": topic} if topic else {}
    wanted |= {"rgb": "jpeg", "jpeg_quality": jpeg} if jpeg else {}
    with StopRequest() as stop, frame_progress("record", None) as bar:
        began = 0.0

        def is_enough(recorder: Recorder) -> bool:
            nonlocal began
            recording = recorder.recording
            if recording is None:
                return False
            began = began or time.monotonic()
            bar.set(recording.frames, recording.trouble)
            return recording.ended or bool(duration and time.monotonic() - began >= duration)

        context, options = _join(launch_folder(launch), tuple(source or ()), wanted, stop)
        done = record_until_end(context, options, is_enough)
    return _report(output, log, done)


def _report(output: Output, log: Path, recorder: Recorder) -> int:
    """Say what is recorded, and what is not; the exit code."""
    done = recorder.recording
    if done is None:
        raise LogError(f"{log}: nothing was recorded: no stream has begun; `view --status` shows the nodes")
    if done.nothing_left:
        raise LogError(f"{log}: its files were removed while it was recorded; record again")
    parts = f" in {done.parts} parts" if done.parts > 1 else ""
    output.print(f"{log}: {counted(done.frames, 'frame')}, {counted(done.messages, 'message')}{parts}")
    if missed := recorder.missing_frames.missed:
        output.print(f"  note: {counted(missed, 'frame')} never came: sent too early, or dropped in transport")
    if done.deleted:
        output.print(f"  note: {counted(done.deleted, 'part')} deleted to make room")
    if not recorder.losses:
        return 0
    output.print(f"  not all is recorded: {recorder.losses}")
    return EXIT_FAILED


def _join(
    folder: Path, sources: tuple[str, ...], wanted: dict[str, Any], stop: StopRequest
) -> tuple[NodeContext, RecorderOptions]:
    """A recorder node in a launch that runs, but without its launcher."""
    note = read_launch_note(folder)
    names = [node.name for node in note.nodes]
    for name in sources:
        if name not in names:
            raise ConfigError(f"--source {name}: no node of {note.launch}; there are {', '.join(names)}")
    cameras = note.names("camera")
    sources = sources or (*cameras, *note.names("mapper"))
    sources = tuple(sorted(sources, key=lambda name: name not in cameras))  # the recorder's order
    streams = sum(name in cameras for name in sources)
    if not streams:
        raise ConfigError(f"--source: name a camera, too, whose end ends the recording: {', '.join(cameras)}")
    endpoints = {name: f"ipc://{folder}/{name}" for name in names}
    heartbeat = HeartbeatWriter(-1, 0)
    context = NodeContext(f"record-{os.getpid()}", endpoints, 0, stop, heartbeat, folder=folder)
    return context, convert_config({**wanted, "sources": sources, "streams": streams}, RecorderOptions, "record")
