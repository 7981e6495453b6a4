"""``semantic-mapper label``: label frames by hand, suggest which, or send labelled ones to a running finetuner."""

import time
from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.config import AtLeastOne
from semantic_mapper.errors import LogError
from semantic_mapper.nodes.cli.verb import JsonOutput, Port, complete_launch, must_be_there, refuse_options, verb
from semantic_mapper.nodes.console import Output, frame_progress, table
from semantic_mapper.nodes.labeller.server import LabelServer, LabelSession
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.launches import socket_in_launch
from semantic_mapper.transport.messages import LabelledKeyframe
from semantic_mapper.transport.sockets import Publisher

FRAMES_TO_LABEL = 8  # that the page shows where nobody says how many
POLL_S = 0.2
LABELS = "labels"  # what launch files call the socket where keyframes come; see ``FinetunerOptions.labels``
DELIVERY_MS = 60_000  # that the last keyframes may take to be read, after which they are lost
FINETUNER_S = 30.0  # how long the finetuner may take to be there


@verb
def label(
    output: JsonOutput,
    log: Path,  # log that the frames are of (.mcap)
    *,
    keyframes: AtLeastOne = 8,  # how many labelled frames to send, where --images names none
    # label images NNNNNN.png (class ids, 8 bits) by number of frame, with a labels.json, in place of the log's.
    # --suggest: labelled already
    images: Annotated[Path | None, typer.Option(metavar="DIR")] = None,
    # endpoint of the finetuner, or socket folder of the launch; by default the one that runs here
    to: Annotated[str, typer.Option(metavar="PLACE", autocompletion=complete_launch)] = "",
    suggest: Annotated[int | None, typer.Option(min=1, metavar="N")] = None,  # say which N frames to label next
    serve: bool = False,  # open a page to paint labels, until Ctrl-C
    # --serve: where labels are saved [LOG-labels]
    out: Annotated[Path | None, typer.Option(metavar="DIR")] = None,
    # --serve: labels.json, or a class a line. Else of the folder, --weights, the log, or the package's weights
    classes: Annotated[Path | None, typer.Option(metavar="FILE")] = None,
    weights: Path | None = None,  # --suggest, --serve: whose keyframes count as labelled
    port: Port = 9092,  # --serve: of the page; 0 = any that is free
) -> None:
    """Label frames of a log by hand, or say which to label.

    --serve opens a page of this machine to paint on the frames that --suggest names: those that show most of what no
    labelled frame shows. Strokes are saved at once; `finetune --labels DIR --strokes` learns from them.

    Without these, labelled frames are sent to a running finetuner: those that together show most of the log. They must
    be in the world that the mapper maps. `view --status --once --json` tells what became of them, `info live` which
    weights came of it.

    Example: semantic-mapper label kitchen.mcap --suggest 8
    Example: semantic-mapper label kitchen.mcap --serve --out kitchen-labels
    Example: semantic-mapper label kitchen.mcap --keyframes 12
    """
    send = suggest is None and not serve
    refuse_options(
        (bool(out or classes) and not serve, "--out and --classes", "go with --serve"),
        (weights is not None and send, "--weights", "goes with --suggest or --serve"),
        (images is not None and serve, "--images", "the page goes on with what is in --out"),
        (bool(to) and not send, "--to", "nothing is sent with --suggest and --serve"),
        (output.quiet and (suggest is None or serve), "--json", "goes with --suggest"),
    )
    must_be_there(log)
    if serve:
        folder = out or log.with_name(f"{log.stem}-labels")
        _serve(output, log, suggest or FRAMES_TO_LABEL, folder, classes, weights, port)
    elif suggest is not None:
        _suggest(output, log, suggest, images, weights)
    else:
        _send(output, log, keyframes, images, to)


def _suggest(output: Output, log: Path, count: int, images: Path | None, weights: Path | None) -> None:
    from semantic_mapper.nodes.cli.labelling import open_images, suggest_for_log

    if images is not None and not images.is_dir():
        raise LogError(f"--images {images}: no such folder")
    with StopRequest() as stop, frame_progress("suggest", None, stop=stop) as bar, open_log(log) as opened:
        found = suggest_for_log(opened, count, open_images(images, opened), weights, bar)
    if found.frames:
        rows = [
            (frame["number"], *("" if frame[key] is None else f"{100 * frame[key]:.1f} %" for key in ("gain", "shown")))
            for frame in found.frames
        ]
        output.print(table(rows, ("frame", "adds", "shown then")))
        if all(frame["gain"] is None for frame in found.frames):
            output.print("the frames have no depth that says what they show: these are spread evenly over time")
    else:
        output.print(f"{log.name}: its {counted(len(found.labelled), 'labelled frame')} show all that it shows")
    output.json({"log": str(log), "labelled": found.labelled, "frames": found.frames})


def _serve(
    output: Output, log: Path, count: int, out: Path, classes: Path | None, weights: Path | None, port: int
) -> None:
    from semantic_mapper.nodes.cli.labelling import choose_classes, open_images, suggest_for_log
    from semantic_mapper.replay.label_folder import make_label_folder

    with StopRequest() as stop, open_log(log) as opened:
        folder = make_label_folder(out, opened, choose_classes(opened, out, classes, weights))
        with frame_progress("suggest", None, stop=stop) as bar:
            found = suggest_for_log(opened, count, open_images(out, opened), weights, bar)
        # Suggested frames in their order, then those that have labels already.
        order = list(dict.fromkeys([*(frame["number"] for frame in found.frames), *folder.numbers()])) or [0]
        with LabelServer(LabelSession(opened, folder, order), port) as server:
            output.print(f"label at {server.url}")
            output.print(
                f"  saved to {out}: learn from it with `semantic-mapper finetune {log} --labels {out} --strokes`"
            )
            while not stop:
                time.sleep(POLL_S)
        output.print(f"{out}: {counted(len(folder.numbers()), 'labelled frame')} of {log.name}")


def _send(output: Output, log: Path, keyframes: int, images: Path | None, to: str) -> None:
    from semantic_mapper.nodes.cli.labelling import choose_keyframes

    endpoint = socket_in_launch(to, LABELS)
    with StopRequest() as stop, frame_progress("label", None, stop=stop) as bar:
        found, label_set = choose_keyframes(log, keyframes, images, bar)
        with Publisher(endpoint, policy="block", linger_ms=DELIVERY_MS) as publisher:
            if not publisher.wait_for_subscribers("keyframe", 1, FINETUNER_S, stop):
                raise KeyboardInterrupt
            for frame in found.values():
                publisher.publish(encode(LabelledKeyframe(frame, label_set, f"log {log.name}")))
    output.print(f"{counted(len(found), 'labelled keyframe')} sent: frames {', '.join(map(str, found))} of {log.name}")
    if pseudo := sum(frame.label_is_pseudo for frame in found.values()):
        output.print(f"  {pseudo} of them have pseudo labels (`autolabel`): what weights have rendered, right or wrong")
