"""The process of a mapper node."""

from __future__ import annotations

from semantic_mapper.nodes.node import NodeContext, run_node
from semantic_mapper.nodes.options import MapperOptions


def run(context: NodeContext, options: MapperOptions) -> None:
    """Be a mapper; see ``node.run_mapper``."""
    from semantic_mapper.nodes.mapper.node import run_mapper  # loads torch: thread counts are set, and heartbeats go

    run_mapper(context, options)


if __name__ == "__main__":
    run_node(MapperOptions, run)
