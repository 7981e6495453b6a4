"""The node that serves images, map, graph and status to Foxglove."""

from __future__ import annotations

from typing import NoReturn

import structlog

from semantic_mapper.nodes.bridge.feed import lower_priority, run_bridge
from semantic_mapper.nodes.node import NodeContext, run_node
from semantic_mapper.nodes.options import FoxgloveOptions, NodeJob

_log = structlog.get_logger(__name__)


def run_foxglove(context: NodeContext, options: FoxgloveOptions) -> None:
    """Serve until all streams have ended or somebody asks to stop.

    Raises:
        DependencyError: the extra is not installed.
        TransportError: the port is taken, or a socket of the launch cannot be used.
    """
    from semantic_mapper.nodes.foxglove.server import FoxgloveServer  # an extra, which may be missing

    with FoxgloveServer(options.port) as server:
        _log.info("serving", foxglove_websocket=server.url)
        run_bridge(context, options, server)


def main(job: NodeJob | None = None) -> NoReturn:
    """Run the node of this process to its end, then exit."""
    lower_priority()
    run_node(FoxgloveOptions, run_foxglove, job)
