"""The process of a foxglove node."""

from semantic_mapper.nodes.foxglove.node import run_foxglove
from semantic_mapper.nodes.node import run_node
from semantic_mapper.nodes.options import FoxgloveOptions

if __name__ == "__main__":
    run_node(FoxgloveOptions, run_foxglove)
