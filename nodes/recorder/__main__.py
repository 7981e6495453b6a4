"""The process of a recorder node."""

from semantic_mapper.nodes.recorder.node import main

if __name__ == "__main__":
    main()
