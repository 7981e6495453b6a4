"""The process of a zenoh node."""

from semantic_mapper.nodes.zenoh.node import main

if __name__ == "__main__":
    main()
