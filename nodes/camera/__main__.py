"""The process of a camera node."""

from semantic_mapper.nodes.camera.node import main

if __name__ == "__main__":
    main()
