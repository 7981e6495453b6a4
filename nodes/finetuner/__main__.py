"""The process of a finetuner node."""

from semantic_mapper.nodes.finetuner.node import main

if __name__ == "__main__":
    main()
