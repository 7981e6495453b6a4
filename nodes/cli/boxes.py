"""``semantic-mapper boxes``: list and draw the boxes of a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.run_folder import prepare_file

if TYPE_CHECKING:
    from rich.table import Table

    from semantic_mapper.replay.boxes import BoxFile


PICTURES = (".png", ".jpg", ".jpeg")


@verb
def boxes(
    file: Annotated[
        Path,
        typer.Argument(help="boxes.json, the JSON of `query MAP instances`, or XML of KITTI-360."),
    ],
    picture: Annotated[
        Path | None,
        typer.Option(metavar="LOG", help="Draw the boxes over the three frames of a log that show most of them."),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="--picture: what to write (.png, .jpg).")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")] = False,
) -> None:
    """List or draw boxes that say what is where: for `finetune --kind panoptic`.

    The file is JSON that any editor changes (docs/boxes.md).

    Example: semantic-mapper boxes things.json
    Example: semantic-mapper boxes boxes.json --picture kitchen.mcap --out boxes.png
    """
    if (picture is None) is not (out is None):
        raise typer.BadParameter("go together", param_hint="--picture and --out")
    if out is not None and out.suffix.lower() not in PICTURES:
        raise typer.BadParameter(f"a picture ends in {' or '.join(PICTURES)}, got {out}", param_hint="--out")
    if picture is not None and out is not None and _same_file(out, picture):
        raise typer.BadParameter(f"{out} is the log", param_hint="--out")
    output = Output.guarded()
    output.quiet = json
    from semantic_mapper.replay.boxes import load_boxes

    found = load_boxes(file)
    if picture is not None and out is not None:
        output.print(_draw(found, picture, file, out))
    else:
        output.print(box_table(str(file), found))
    if json:
        output.json(describe_boxes(found))


def _same_file(a: Path, b: Path) -> bool:
    return a == b or (a.exists() and b.exists() and a.samefile(b))


def _draw(found: BoxFile, log_path: Path, file: Path, out: Path) -> str:
    from semantic_mapper.plots import write_picture
    from semantic_mapper.replay.box_picture import draw_boxes
    from semantic_mapper.replay.boxes import with_times
    from semantic_mapper.replay.log.sequence import open_log

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


def describe_boxes(found: BoxFile) -> dict[str, Any]:
    """The boxes as plain data, lengths in metres rounded to tenths of millimetres."""
    import numpy as np

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


def box_table(title: str, found: BoxFile) -> Table:
    """The boxes, for people."""
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for name in ("id", "class", "shape", "thing", "centre, m", "size, m", "times"):
        table.add_column(name, overflow="fold")
    for box in describe_boxes(found)["boxes"]:
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
