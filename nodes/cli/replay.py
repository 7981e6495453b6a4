"""``semantic-mapper replay``: a log becomes a map, in this process."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from semantic_mapper.nodes.cli.verb import EXIT_UNTRUSTED, must_be_there, verb
from semantic_mapper.nodes.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.summary import dig, notes, result_lines, summary_table

OutOption = Annotated[Path, typer.Option("--out", help="Folder for the results; made if missing.")]
WeightsOption = Annotated[
    Path | None,
    typer.Option(
        "--weights",
        help="Weights file, or `rooms-computed-depth` for cameras without a depth sensor; without it the small one in "
        "the package.",
    ),
]
VoxelSizeOption = Annotated[
    float | None, typer.Option("--voxel-size", min=0.002, max=1.0, help="Edge of a voxel in metres.  [default: 0.02]")
]
MaxFramesOption = Annotated[int, typer.Option("--max-frames", min=0, help="Stop after this many; 0 = all.")]
QualityOption = Annotated[
    Literal["fast", "balanced", "reference"] | None,
    typer.Option("--quality", help="Rays and samples: fewer, some or all; without it as --config says."),
]
DepthOption = Annotated[
    Literal["auto", "sensor", "computed", "off"] | None,
    typer.Option(
        "--depth",
        help="auto: the sensor's, and computed from the pictures where a frame has none; sensor or off: rendered by "
        "the field where it has none, or always; without it as --config says.",
    ),
]
ConfigOption = Annotated[Path | None, typer.Option("--config", help="TOML file with settings of the mapper.")]
AcceptOption = Annotated[
    bool,
    typer.Option(
        "--accept-contradictions", help="Exit code 0 although poses and depth contradict each other (else 3)."
    ),
]


def map_exit_code(summary: Mapping[str, Any], stop: StopRequest, accept_contradictions: bool) -> int:
    """Of a verb that has made a map: that of the signal that stopped it, or 3 where the map cannot be trusted."""
    untrusted = dig(summary, "pose_check.warning") and not accept_contradictions
    empty = not dig(summary, "map.surface_points")
    return stop.exit_code or (EXIT_UNTRUSTED if untrusted or empty else 0)


@verb
def replay(
    log: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Recorded log (.mcap), the parts of one, or a folder with them."),
    ],
    out: OutOption,
    weights: WeightsOption = None,
    voxel_size: VoxelSizeOption = None,
    max_frames: MaxFramesOption = 0,
    eval_exclude: Annotated[
        Path | None,
        typer.Option(help="Leave frames that these weights were finetuned on out of the scores, too."),
    ] = None,
    json: Annotated[
        bool, typer.Option("--json", help="Print the summary as JSON, and nothing else, on stdout.")
    ] = False,
    rerun: Annotated[Path | None, typer.Option(help="Also write a Rerun recording (.rrd).")] = None,
    config: ConfigOption = None,
    quality: QualityOption = None,
    depth: DepthOption = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of everything that is drawn at random.")] = None,
    corrections: Annotated[
        Path | None,
        typer.Option(help="Corrected poses (TUM: stamp tx ty tz qx qy qz qw); the map moves to them at the end."),
    ] = None,
    accept_contradictions: AcceptOption = False,
) -> int:
    """Map a recorded log: writes report.html, summary.json, map.ply, map.npz and overview.png.

    Frames that the weights were finetuned on are mapped, but never scored. Damaged or impossible frames are refused
    with the reason; the rest is mapped. Ctrl-C still writes the map of the frames so far (exit code 130).
    Where poses and depth contradict each other, the map is written and the exit code is 3.

    Example: semantic-mapper replay kitchen.mcap --out runs/kitchen --weights kitchen.safetensors
    """
    must_be_there(*log)
    output = Output.guarded()
    from semantic_mapper.config import load_mapper_config
    from semantic_mapper.replay.jobs import OFFLINE, ReplayRequest, replay_log

    given = {"voxel_map.voxel_size_m": voxel_size, "seed": seed, "quality": quality, "depth.source": depth}
    settings = load_mapper_config(config, given, OFFLINE)
    request = ReplayRequest(
        log[0], out, weights, settings, max_frames, eval_exclude, rerun, corrections, tuple(log[1:])
    )
    with StopRequest() as stop:
        with frame_progress("replay", None, stop=stop) as bar:
            summary = replay_log(request, bar).summary
        if json:
            output.json(summary)
        else:
            show_replay(output, summary, out)
        if stop:
            stderr_console().print(f"stopped by {stop.name}; the map so far is in {out}", style="yellow")
        return map_exit_code(summary, stop, accept_contradictions)


def show_replay(output: Output, summary: Mapping[str, Any], out: Path) -> None:
    """Table, notes and files of one replay, for people."""
    output.print(summary_table({out.name: summary}))
    for line in (*notes(summary), *result_lines(out)):
        output.print(line)
