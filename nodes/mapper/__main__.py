"""The process of a mapper node."""

from semantic_mapper.nodes.mapper.node import main

if __name__ == "__main__":
    main()
