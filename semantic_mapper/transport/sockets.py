"""ZeroMQ sockets of the system: ``Publisher``, and the two ways to subscribe."""

from __future__ import annotations

from semantic_mapper.transport.publisher import Publisher
from semantic_mapper.transport.subscribers import LosslessSubscriber, NewestSubscriber

__all__ = ["LosslessSubscriber", "NewestSubscriber", "Publisher"]
