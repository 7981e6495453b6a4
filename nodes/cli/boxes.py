"""``semantic-mapper boxes``: list, change and draw the boxes of a file."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.cli.console import Output
from semantic_mapper.nodes.cli.outputs import prepare_file
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.plain_text import counted

if TYPE_CHECKING:
    from rich.table import Table

    from semantic_mapper.replay.box_edits import BoxEditor
    from semantic_mapper.replay.boxes import BoxFile


class Action(StrEnum):
    """What to do with the boxes."""

    LIST = "list"
    DELETE = "delete"
    RECLASS = "reclass"
    MOVE = "move"
    RESIZE = "resize"
    TURN = "turn"
    DUPLICATE = "duplicate"
    TIMES = "times"
    PICTURE = "picture"


ARGUMENTS = {
    Action.LIST: "",
    Action.DELETE: "ID...",
    Action.RECLASS: "ID CLASS",
    Action.MOVE: "ID X Y Z",
    Action.RESIZE: "ID X Y Z",
    Action.TURN: "ID DEGREES",
    Action.DUPLICATE: "ID",
    Action.TIMES: "LOG",
    Action.PICTURE: "LOG",
}
PICTURES = (".png", ".jpg", ".jpeg")
AT_TIMES = (Action.MOVE, Action.TURN, Action.DUPLICATE)  # that --at-ns goes with


@verb
def boxes(
    file: Annotated[
        Path,
        typer.Argument(help="boxes.json, the JSON of `query MAP instances`, or XML of KITTI-360."),
    ],
    action: Annotated[
        Action,
        typer.Argument(
            metavar="ACTION",
            help="list, delete, reclass, move, resize, turn, duplicate, times or picture.",
            show_default=False,
        ),
    ] = Action.LIST,
    arguments: Annotated[
        list[str] | None, typer.Argument(metavar="[ID] [CLASS|X Y Z|DEGREES|LOG]", help="What the action needs.")
    ] = None,
    at_ns: Annotated[
        int | None,
        typer.Option(
            "--at-ns",
            metavar="NS",
            help="move, turn: at this one of the times of a box that moves, else at all. duplicate: the box is also "
            "there at this time, instead of twice.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The changed boxes (.json), or the picture (.png, .jpg).")
    ] = None,
    in_place: Annotated[bool, typer.Option("--in-place", help="Change the file itself.")] = False,
    json: Annotated[bool, typer.Option("--json", help="list: print JSON, and nothing else, on stdout.")] = False,
) -> None:
    """List, change or draw boxes that say what is where: for `finetune --kind panoptic`.

    move shifts a box by metres along the axes of the world, turn turns it round its own upright axis (anticlockwise
    from above), resize gives it another size along its own axes. duplicate puts a copy with a new id in the same place,
    to be moved. times gives boxes of KITTI-360 that move, whose poses are by frame, the times of a log of their drive.
    picture draws the boxes over the three frames of a log that show most of them, and from above.

    Example: semantic-mapper boxes things.json list
    Example: semantic-mapper boxes things.json delete 4 7 --out boxes.json
    Example: semantic-mapper boxes boxes.json reclass 3 cabinet --in-place
    Example: semantic-mapper boxes boxes.json move 3 0.1 0 -0.05 --in-place
    Example: semantic-mapper boxes boxes.json picture kitchen.mcap --out boxes.png
    """
    words = arguments or []
    _check_usage(action, words, at_ns, out, in_place=in_place, json=json)
    output = Output.guarded()
    from semantic_mapper.replay.boxes import load_boxes, read_boxes, save_boxes

    output.quiet = json
    found = read_boxes(file) if action is Action.DELETE else load_boxes(file)
    if action is Action.LIST:
        if json:
            output.json(describe_boxes(found))
        output.print(box_table(str(file), found))
        return
    if action is Action.PICTURE:
        assert out is not None  # or it was wrong usage
        output.print(_draw(found, Path(words[0]), file, out))
        return
    target = out or file
    if found.is_xml and _same_file(target, file):
        raise ConfigError(f"{file}: boxes are written as JSON; give --out FILE.json")
    changed, done = _changed(file, found, action, words, at_ns)
    prepare_file(target)
    save_boxes(target, changed)
    output.print(f"{done}; {counted(len(changed.primitives), 'box', 'boxes')} written to {target}")


def _check_usage(
    action: Action, words: list[str], at_ns: int | None, out: Path | None, *, in_place: bool, json: bool
) -> None:
    wanted = ARGUMENTS[action].split()
    if len(words) < len(wanted) or (len(words) > len(wanted) and action is not Action.DELETE):
        needs = ARGUMENTS[action] or "nothing"
        raise typer.BadParameter(f"{action} takes {needs}, got {' '.join(words) or 'nothing'}", param_hint=action)
    edits = action not in (Action.LIST, Action.PICTURE)
    if edits and (out is None) is not in_place:
        raise typer.BadParameter(f"{action} needs --out FILE or --in-place, one of them", param_hint="--out")
    if not edits and (in_place or (out is None) is (action is Action.PICTURE)):
        usage = "picture needs --out FILE.png" if action is Action.PICTURE else "list writes no file"
        raise typer.BadParameter(usage, param_hint="--out")
    if out is not None:
        _check_name(action, words, out)
    if at_ns is not None and action not in AT_TIMES:
        raise typer.BadParameter(f"goes with {', '.join(AT_TIMES)}", param_hint="--at-ns")
    if json and action is not Action.LIST:
        raise typer.BadParameter("goes with list", param_hint="--json")


def _check_name(action: Action, words: list[str], out: Path) -> None:
    wanted = PICTURES if action is Action.PICTURE else (".json",)
    if out.suffix.lower() not in wanted:
        raise typer.BadParameter(f"{action} writes {' or '.join(wanted)}, got {out}", param_hint="--out")
    if action in (Action.PICTURE, Action.TIMES) and _same_file(out, Path(words[0])):
        raise typer.BadParameter(f"{out} is the log", param_hint="--out")


def _same_file(a: Path, b: Path) -> bool:
    return a == b or (a.exists() and b.exists() and a.samefile(b))


def _changed(file: Path, found: BoxFile, action: Action, words: list[str], at_ns: int | None) -> tuple[BoxFile, str]:
    """The changed boxes, and what was done."""
    from semantic_mapper.replay.box_edits import BoxEditor, with_times
    from semantic_mapper.replay.log.sequence import open_log

    if action is Action.TIMES:
        by_frame = sum(box.frames is not None for box in found.primitives)
        with open_log(Path(words[0])) as log:
            changed, dropped = with_times(found, file, log)
        gone = f", {len(dropped)} that are at none of its frames dropped" if dropped else ""
        return (
            changed,
            f"{counted(by_frame - len(dropped), 'box', 'boxes')} with times of {words[0]} instead of frames{gone}",
        )
    editor = BoxEditor(file, found)
    done = _edit(editor, action, words, at_ns)
    return editor.boxes, done


def _edit(editor: BoxEditor, action: Action, words: list[str], at_ns: int | None) -> str:
    """Do it, and say what was done."""
    import numpy as np

    if action is Action.DELETE:
        ids = [_whole(word) for word in words]
        editor.delete(ids)
        return f"box {', '.join(map(str, ids))} deleted"
    box_id = _whole(words[0])
    if action is Action.RECLASS:
        editor.reclass(box_id, words[1])
        alone = sum(box.class_name == words[1] for box in editor.boxes.primitives) == 1
        return f"box {box_id} is of class {words[1]}" + (", as no other box of the file" if alone else "")
    if action is Action.DUPLICATE:
        if at_ns is None:
            return f"box {editor.duplicate(box_id)} is a copy of box {box_id}"
        times = editor.add_time(box_id, at_ns)
        return f"box {box_id} is there at {at_ns} ns, " + (
            f"one of {times} times" if times > 1 else "and moves from now on"
        )
    numbers = np.array([_number(word) for word in words[1:]])
    if action is Action.MOVE:
        editor.move(box_id, numbers, at_ns)
    elif action is Action.TURN:
        editor.turn(box_id, float(np.deg2rad(numbers[0])), at_ns)
    else:
        editor.resize(box_id, numbers)
    past = {Action.MOVE: "moved", Action.TURN: "turned", Action.RESIZE: "resized"}
    return f"box {box_id} {past[action]}"


def _whole(word: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise typer.BadParameter(f"must be a box's id, a whole number, got '{word:.20}'", param_hint="ID") from None


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise typer.BadParameter(f"must be a number, got '{word}'", param_hint="X Y Z") from None


def _draw(found: BoxFile, log_path: Path, file: Path, out: Path) -> str:
    from semantic_mapper.plots import write_picture
    from semantic_mapper.replay.box_edits import with_times
    from semantic_mapper.replay.box_picture import draw_boxes
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
    bad = [{"number": b.number, "id": b.id, "problem": b.problem} for b in found.bad]
    return {"boxes": listed, "merge": merge, "left_out": found.left_out, "bad": bad}


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
