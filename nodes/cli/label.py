"""``semantic-mapper label``: label frames by hand, suggest which, or send labelled ones to a running finetuner."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.errors import LogError, TransportError
from semantic_mapper.nodes.cli.verb import must_be_there, verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.nodes.labeller.server import LabelServer, LabelSession
from semantic_mapper.nodes.launcher.running import NOTE, read_launch_note
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.transport.messages import LabelledKeyframe

FRAMES_TO_LABEL = 8  # that the page shows where nobody says how many
POLL_S = 0.2


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
            "log's own; with a labels.json, or in the log's classes. --suggest: what is labelled already.",
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
    teacher: Annotated[
        str, typer.Option(hidden=True, help="Who has labelled them, for the log of the finetuner.")
    ] = "",
    timeout: Annotated[
        float, typer.Option(min=0, hidden=True, help="How long the finetuner may take to be there, seconds.")
    ] = 30.0,
    suggest: Annotated[
        int | None,
        typer.Option("--suggest", metavar="N", min=1, help="Say which N frames to label next, and send nothing."),
    ] = None,
    serve: Annotated[
        bool,
        typer.Option("--serve", help="Open a page on this machine to paint labels on suggested frames, until Ctrl-C."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="--serve: where labels are saved [LOG-labels, next to the log]."),
    ] = None,
    classes: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="--serve: a labels.json, or a text with a class a line. Else those of the folder, of --weights, of "
            "the log, or of the weights in the package.",
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(help="--suggest, --serve: weights whose keyframes count as labelled; also their classes."),
    ] = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, hidden=True, help="--serve: of the page; 0 = any that is free.")
    ] = 9092,
    json: Annotated[bool, typer.Option("--json", help="--suggest: print JSON, and nothing else, on stdout.")] = False,
) -> int:
    """Label frames of a log by hand (--serve), or say which to label (--suggest); or send labelled ones to a finetuner.

    --suggest names the frames that show most surface which no labelled frame shows. --serve opens a page on which a
    person paints on them, saves each stroke at once, and shows what strokes grow to. `finetune --labels DIR --strokes`
    learns from that, without --strokes from painted pixels alone. The page is on this machine alone; to see it from
    another one, tunnel its port.

    Without these, labelled frames are sent to a running finetuner: those that together show most of what the log shows.
    Frames must be in the world that the mapper maps. `semantic-mapper view --status --once --json` tells what became
    of them, `semantic-mapper info live` which weights came of it.

    Example: semantic-mapper label kitchen.mcap --suggest 8
    Example: semantic-mapper label kitchen.mcap --serve --classes classes.txt --out kitchen-labels
    Example: semantic-mapper label kitchen.mcap --keyframes 12
    """
    numbers = frame_numbers(frames)
    _check_options(
        suggest is not None,
        serve,
        {
            "--out": out,
            "--classes": classes,
            "--weights": weights,
            "--json": json,
            "--images": images,
            "--frames": frames,
            "--to": to,
            "--teacher": teacher,
        },
    )
    must_be_there(log)
    output = Output.guarded()
    if serve:
        return _serve(output, log, numbers, suggest, out or log.with_name(f"{log.stem}-labels"), classes, weights, port)
    if suggest is not None:
        output.quiet = json
        _suggest(output, log, suggest, images, weights, json)
        return 0
    _send(output, log, keyframes, numbers, images, to, teacher, timeout)
    return 0


def _check_options(suggest: bool, serve: bool, given: dict[str, object]) -> None:
    """Refuse options whose mode is not requested.

    Raises:
        typer.BadParameter: naming the mode.
    """
    send = not suggest and not serve
    modes = {
        "--out": (serve, "goes with --serve"),
        "--classes": (serve, "goes with --serve"),
        "--weights": (not send, "goes with --suggest or --serve"),
        "--json": (suggest and not serve, "goes with --suggest"),
        "--images": (not serve, "the page goes on with what is in --out"),
        "--frames": (not suggest, "frames are named or suggested, not both"),
        "--to": (send, "nothing is sent with --suggest and --serve"),
        "--teacher": (send, "nothing is sent with --suggest and --serve"),
    }
    for name, value in given.items():
        if value and not modes[name][0]:
            raise typer.BadParameter(modes[name][1], param_hint=name)


def _suggest(output: Output, log: Path, count: int, images: Path | None, weights: Path | None, json: bool) -> None:
    from semantic_mapper.nodes.cli.labelling import open_images, suggest_for_log, suggestion_table

    if images is not None and not images.is_dir():
        raise LogError(f"--images {images}: no such folder")
    with StopRequest() as stop, frame_progress("suggest", None) as bar, open_log(log) as opened:
        found = suggest_for_log(opened, count, open_images(images, opened), weights, stop, bar)
    if found.frames:
        output.print(suggestion_table(found))
        if all(frame.brings.gain is None for frame in found.frames):
            output.print("the frames have no depth that says what they show: these are spread evenly over time")
    else:
        output.print(f"{log.name}: its {counted(len(found.labelled), 'labelled frame')} show all that it shows")
    if json:
        output.json({"log": str(log), **found.plain()})


def _serve(
    output: Output,
    log: Path,
    frames: list[int],
    suggest: int | None,
    out: Path,
    classes: Path | None,
    weights: Path | None,
    port: int,
) -> int:
    from semantic_mapper.nodes.cli.labelling import open_images, page_folder, page_order, suggest_for_log

    with StopRequest() as stop, open_log(log) as opened:
        folder = page_folder(opened, out, classes, weights)
        if beyond := [n for n in frames if n >= len(opened)]:
            raise LogError(f"{log}: has no frame {beyond[0]}; it has {len(opened)}")
        chosen = frames
        if not chosen:
            with frame_progress("suggest", None) as bar:
                images = open_images(out, opened)
                found = suggest_for_log(opened, suggest or FRAMES_TO_LABEL, images, weights, stop, bar)
            chosen = [frame.number for frame in found.frames]
        order = page_order(chosen, folder.numbers()) or [0]
        with LabelServer(LabelSession(opened, folder, order), port) as server:
            output.print(f"label at {server.url}")
            output.print(
                f"  saved to {out}: learn from it with `semantic-mapper finetune {log} --labels {out} --strokes`"
            )
            while not stop:
                time.sleep(POLL_S)
        output.print(f"{out}: {counted(len(folder.numbers()), 'labelled frame')} of {log.name}")
    return 0


def _send(
    output: Output,
    log: Path,
    keyframes: int,
    numbers: list[int],
    images: Path | None,
    to: str,
    teacher: str,
    timeout: float,
) -> None:
    from semantic_mapper.nodes.cli.labelling import choose_keyframes, labels_endpoint, sending

    endpoint = labels_endpoint(to)
    if "://" not in to:
        _refuse_without_finetuner(Path(endpoint.removeprefix("ipc://")).parent)
    with StopRequest() as stop, frame_progress("label", None, stop=stop) as bar:
        found, label_set = choose_keyframes(log, keyframes, numbers, images, stop, bar)
        with sending(endpoint, timeout, stop) as send:
            for frame in found.values():
                send(LabelledKeyframe(frame, label_set, teacher or f"log {log.name}"))
    output.print(f"{counted(len(found), 'labelled keyframe')} sent: frames {', '.join(map(str, found))} of {log.name}")
    if pseudo := sum(frame.label_is_pseudo for frame in found.values()):
        output.print(f"  {pseudo} of them have pseudo labels (`autolabel`): what weights have rendered, right or wrong")


def _refuse_without_finetuner(folder: Path) -> None:
    """Say at once, rather than after ``--timeout``, that nobody in a launch will ever listen.

    Raises:
        TransportError: the launch has no finetuner.
    """
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
    if not all(word.isdecimal() and len(word) < 20 for word in words):
        raise typer.BadParameter(f"numbers with commas between them, got {text:.80}", param_hint="--frames")
    return [int(word) for word in words]
