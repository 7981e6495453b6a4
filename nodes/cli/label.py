"""``semantic-mapper label``: label frames by hand, suggest which, or send labelled ones to a running finetuner."""

from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.config import AtLeastOne
from semantic_mapper.nodes.cli.verb import JsonOutput, Port, complete_launch, must_be_there, refuse_options, verb

FRAMES_TO_LABEL = 8  # that the page shows where nobody says how many


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
    from semantic_mapper.nodes.cli import labelling  # loads torch

    if serve:
        folder = out or log.with_name(f"{log.stem}-labels")
        labelling.serve(output, log, suggest or FRAMES_TO_LABEL, folder, classes, weights, port)
    elif suggest is not None:
        labelling.suggest(output, log, suggest, images, weights)
    else:
        labelling.send(output, log, keyframes, images, to)
