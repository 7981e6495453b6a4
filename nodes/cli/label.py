"""``semantic-mapper label``: send labelled keyframes to a finetuner that learns beside a mapper."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.nodes.cli.console import Output, frame_progress
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.plain_text import counted


@verb
def label(
    log: Annotated[Path, typer.Argument(help="Log that the frames are of (.mcap).")],
    keyframes: Annotated[
        int,
        typer.Option("--keyframes", min=1, help="How many of its labelled frames to send, where no others are named."),
    ] = 8,
    frames: Annotated[str, typer.Option(metavar="N,N,...", help="Numbers of the frames in the log, instead.")] = "",
    images: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Label images NNNNNN.png (uint8 class ids), each named by the number of its frame, in place of the "
            "log's own; with a labels.json, or in the log's classes.",
        ),
    ] = None,
    to: Annotated[
        str,
        typer.Option(
            metavar="PLACE",
            help="Where the finetuner listens (its option `labels`): an endpoint, or the socket folder of the launch; "
            "by default the one that runs here.",
        ),
    ] = "",
    teacher: Annotated[str, typer.Option(help="Who has labelled them, for the log of the finetuner.")] = "",
    timeout: Annotated[float, typer.Option(min=0, help="How long the finetuner may take to be there, seconds.")] = 30.0,
) -> None:
    """Send labelled frames of a log to a running finetuner, which learns from them.

    Without further options those are sent that together show most of what the log shows. Frames must be in the world
    that the mapper maps. `semantic-mapper top --once --json` tells what became of them, `semantic-mapper weights` which
    weights came of it.

    Example: semantic-mapper label kitchen.mcap --keyframes 12
    Example: semantic-mapper label kitchen.mcap --images corrected/ --to ipc:///run/robot/labels
    """
    numbers = frame_numbers(frames)
    output = Output.guarded()
    from semantic_mapper.nodes.cli.labelling import choose_keyframes, labels_endpoint, sending
    from semantic_mapper.transport.messages import LabelledKeyframe

    endpoint = labels_endpoint(to)
    if "://" not in to:
        _refuse_without_finetuner(Path(endpoint.removeprefix("ipc://")).parent)
    with StopRequest() as stop, frame_progress("label", None) as bar:
        chosen, label_set = choose_keyframes(log, keyframes, numbers, images, stop, bar)
        with sending(endpoint, timeout, stop) as send:
            for frame in chosen:
                send(LabelledKeyframe(frame, label_set, teacher or f"log {log.name}"))
    output.print(
        f"{counted(len(chosen), 'labelled keyframe')} sent: frames {', '.join(str(f.seq) for f in chosen)} "
        f"of {log.name}"
    )
    if pseudo := sum(frame.label_is_pseudo for frame in chosen):
        output.print(f"  {pseudo} of them have pseudo labels (`autolabel`): what weights have rendered, right or wrong")


def _refuse_without_finetuner(folder: Path) -> None:
    """Say at once, rather than after ``--timeout``, that nobody in a launch will ever listen.

    Raises:
        TransportError: the launch has no finetuner.
    """
    from semantic_mapper.errors import TransportError
    from semantic_mapper.nodes.supervisor.launch_note import NOTE, read_launch_note

    if not (folder / NOTE).exists():
        return
    note = read_launch_note(folder)
    if not note.names("finetuner"):
        nodes = ", ".join(f"{node.name} ({node.kind})" for node in note.nodes)
        raise TransportError(
            f"{folder}: {note.launch} has no finetuner to label for, its nodes are {nodes}; add one as in "
            "launch/learning.toml, or say with --to where one listens (its option `labels`)"
        )


def frame_numbers(text: str) -> list[int]:
    """Numbers of frames, as an option names them."""
    words = [word for word in text.replace(" ", "").split(",") if word]
    if not all(word.isdecimal() for word in words):
        raise typer.BadParameter(f"numbers with commas between them, got {text}", param_hint="--frames")
    return [int(word) for word in words]
