"""The node that publishes images, map, graph and status to Zenoh."""

from __future__ import annotations

from typing import NoReturn

import structlog

from semantic_mapper.nodes.node import NodeContext, run_node
from semantic_mapper.nodes.options import NodeJob, ZenohOptions

_log = structlog.get_logger(__name__)


def run_zenoh(context: NodeContext, options: ZenohOptions) -> None:
    """Publish until all streams have ended or somebody asks to stop.

    Raises:
        ConfigError: an address or certificates that cannot be used.
        DependencyError: the extra is not installed.
        TransportError: the address is taken, or a socket of the launch cannot be used.
    """
    from semantic_mapper.nodes.bridge.feed import run_bridge
    from semantic_mapper.nodes.zenoh.session import ZenohSession

    with ZenohSession(options) as session:
        _log.info("publishing", keys=f"{options.prefix}/**", listen=options.listen, connect=options.connect)
        run_bridge(context, options, session)


def main(job: NodeJob | None = None) -> NoReturn:
    """Run the node of this process to its end, then exit."""
    from semantic_mapper.nodes.bridge.feed import lower_priority

    lower_priority()
    run_node(ZenohOptions, run_zenoh, job)
