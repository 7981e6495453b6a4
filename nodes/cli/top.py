"""``semantic-mapper top``: how the nodes of a running launch are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from semantic_mapper.errors import TransportError
from semantic_mapper.nodes.cli.remote import KeysOption, ServerOption, server_identity
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.process import StopRequest

if TYPE_CHECKING:
    from semantic_mapper.nodes.launcher.launch_view import LaunchView
    from semantic_mapper.transport.sockets import NewestSubscriber

ANSWER_S = 5.0  # how long the launcher may take to say anything
REFRESH_S = 0.5
FILE_WIDTH = 140  # columns where nothing says how many there are


@verb
def top(
    place: Annotated[
        str,
        typer.Argument(
            metavar="[LAUNCH]", help="Socket folder of the launch, or endpoint of its status; by default the one here."
        ),
    ] = "",
    once: Annotated[bool, typer.Option("--once", help="Show it once and end, instead of until Ctrl-C.")] = False,
    json: Annotated[bool, typer.Option("--json", help="With --once: one JSON document instead of the table.")] = False,
    server: ServerOption = "",
    keys: KeysOption = None,
) -> None:
    """Show the nodes of a running launch: states, restarts, memory, rates, ages and what was lost, twice a second.

    frames/s: that a camera published, that came to the mapper, or that were recorded. mapped/s: fused. step: mean time
    to map one. frame: since the last one. age: of the last one when it was mapped, where its clock is this machine's
    monotonic one. msgs/s, log: messages recorded, size of the recording. lost: of a camera, images that became no
    frame, such as those without a pose; of the mapper, frames that never came (newer ones took their place) or could
    not be used; of the recorder, what never came or had no room. beat: since the last sign of life.

    A launch on another machine is named by its endpoint (`publish` of the launch file).

    Example: semantic-mapper top
    Example: semantic-mapper top tcp://robot:5562 --server robot
    Example: semantic-mapper top --once --json
    """
    if json and not once:
        raise typer.BadParameter("--json goes with --once")
    output = Output.guarded()
    from semantic_mapper.nodes.launcher.launch_view import LaunchView
    from semantic_mapper.nodes.launcher.running import status_endpoint
    from semantic_mapper.transport.sockets import NewestSubscriber

    if not output.console.is_terminal:
        output.console.width = FILE_WIDTH
    endpoint = status_endpoint(place)
    view = LaunchView()
    with NewestSubscriber(endpoint, ("status",), identity=server_identity(server, keys)) as subscriber:
        _wait_for_all(view, subscriber, endpoint)
        if json:
            output.json(view.to_json())
        elif once:
            output.print(view.table())
        else:
            _follow(view, subscriber, output)


def _wait_for_all(view: LaunchView, subscriber: NewestSubscriber, endpoint: str) -> None:
    waited = 0.0
    while not view.complete:
        if waited > ANSWER_S:
            raise TransportError(f"{endpoint}: no launcher has reported its nodes for {ANSWER_S:g} s; does it run?")
        view.listen(subscriber, REFRESH_S)
        waited += REFRESH_S


def _follow(view: LaunchView, subscriber: NewestSubscriber, output: Output) -> None:
    from rich.live import Live

    with StopRequest() as stop, Live(view.table(), console=output.console, auto_refresh=False) as live:
        while not stop and not view.ended and view.silent_s < ANSWER_S:
            view.listen(subscriber, REFRESH_S)
            live.update(view.table(), refresh=True)
    if not stop:
        output.print("the launch has ended" if view.ended else "the launcher says nothing any more")
