"""The process of a recorder node."""

from semantic_mapper.nodes.node import run_node
from semantic_mapper.nodes.options import RecorderOptions
from semantic_mapper.nodes.recorder.node import run_recorder

if __name__ == "__main__":
    run_node(RecorderOptions, run_recorder)
