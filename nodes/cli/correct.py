"""``semantic-mapper correct``: send corrected poses to a running mapper."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.cli.remote import KeysOption, ServerOption, server_identity
from semantic_mapper.nodes.cli.verb import EXIT_FAILED, verb
from semantic_mapper.nodes.console import Output, frame_progress

if TYPE_CHECKING:
    from semantic_mapper.client import Correction, MapClient

POLL_S = 0.2


@verb
def correct(
    endpoint: Annotated[
        str,
        typer.Argument(
            help="`live` for the launch that runs here, or where its mapper answers (ipc://PATH, tcp://HOST:PORT)."
        ),
    ],
    file: Annotated[
        Path, typer.Argument(help="Corrected poses, as of `replay --corrections` (TUM: stamp tx ty tz qx qy qz qw).")
    ],
    camera: Annotated[str, typer.Option(help="The camera that they are of; needed where the mapper has several.")] = "",
    apply_until: Annotated[
        float | None,
        typer.Option(
            min=0,
            metavar="SECONDS",
            help="Frames after this time are posed in the corrected world already; without it, all that come after the "
            "last pose of the file move with that pose, those to come as well.",
        ),
    ] = None,
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Until the map has moved.")] = True,
    server: ServerOption = "",
    keys: KeysOption = None,
    json: Annotated[
        bool, typer.Option("--json", help="Print the outcome as JSON, and nothing else, on stdout.")
    ] = False,
) -> int:
    """Move the map of a running mapper to corrected poses, after a loop closure, say.

    The mapper has to keep its frames (`history.max_frames` in its config). It goes on mapping and answering meanwhile,
    and exchanges the map when the corrected one is ready. A pose goes to the frame nearest in time, within 5 ms; frames
    between two given ones move with both.

    Example: semantic-mapper correct live optimised.tum
    """
    output = Output.guarded()
    from semantic_mapper.client import MapClient
    from semantic_mapper.mapping.correction import ALWAYS
    from semantic_mapper.nodes.supervisor.running_launches import map_endpoint
    from semantic_mapper.replay.corrected_poses import MATCH_NS, read_corrections

    if "://" not in endpoint and Path(endpoint).exists():
        raise ConfigError(
            f"{endpoint}: is no running mapper; a saved map keeps no frames to correct, so map its log again with "
            f"`semantic-mapper replay LOG --corrections {file} --out FOLDER`"
        )
    trajectory = read_corrections(file)
    pairs = zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True)
    poses = {(camera, stamp_ns): pose for stamp_ns, pose in pairs}
    until_ns = ALWAYS if apply_until is None else round(apply_until * 1e9)
    endpoint = map_endpoint(endpoint) or endpoint
    with MapClient(endpoint, identity=server_identity(server, keys)) as client:
        begun = client.correct_poses(poses, until_ns=until_ns, within_ns=MATCH_NS)
        state = _follow(client) if wait else begun
    outcome = {**asdict(state), "used": begun.used, "left_out": begun.left_out}
    if json:
        output.json(outcome)
    else:
        left_out = f"; {begun.left_out} have no frame in the history and were left out" if begun.left_out else ""
        output.print(f"{begun.used} corrected poses {_stand(state)}{left_out}")
    return EXIT_FAILED if state.failure else 0


def _follow(client: MapClient) -> Correction:
    """Wait until no correction is under way."""
    with frame_progress("correct", None) as bar:
        state = client.correction()
        bar.start(state.total)
        while state.running:
            bar.set(state.done, f"of {state.total}")  # frames that come meanwhile are added
            time.sleep(POLL_S)
            state = client.correction()
    return state


def _stand(state: Correction) -> str:
    if state.failure:
        return f"were given up, the map is as it was: {state.failure}"
    if state.running:
        return f"are being worked into the map: {state.done} of {state.total} frames"
    return "are in the map"
