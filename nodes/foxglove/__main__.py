"""The process of a foxglove node."""

from semantic_mapper.nodes.foxglove.node import main

if __name__ == "__main__":
    main()
