"""What a node that publishes frames waits for: listeners before the first one, delivery after the last."""

import time

from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

DRAIN_S = 600.0  # how long subscribers may take to work off what waits for them after the last frame
START_S = 180.0  # how long subscribers may take to start
STOP_DRAIN_S = 3.0  # the same after a stop request
REMIND_S = 2.0  # how often the end is said again meanwhile


def wait_for_listeners(context: NodeContext, publisher: Publisher, acks: LosslessSubscriber | None = None) -> bool:
    """Wait until all others are there: False where a stop request came first. ``TransportError``: too few in time."""
    there = publisher.wait_for_subscribers("frame", context.subscribers, START_S, context.stop)
    return there and (acks is None or acks.wait_until_heard(START_S, context.stop))


def drain(context: NodeContext, publisher: Publisher) -> None:
    """Stay until the subscribers have left, which they do after the end of the stream: only then is all delivered.

    The end is said again and again: who was suspended, or too slow for a live stream, may have had no room for it.
    """
    began = reminded = time.monotonic()
    while publisher.subscribers("frame") and time.monotonic() - began < (STOP_DRAIN_S if context.stop else DRAIN_S):
        if time.monotonic() - reminded > REMIND_S:
            reminded = time.monotonic()
            publisher.remind("end")
        time.sleep(0.05)
