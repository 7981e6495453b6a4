"""The process of a camera node."""

from semantic_mapper.nodes.camera.node import run_camera
from semantic_mapper.nodes.node import run_node
from semantic_mapper.nodes.options import CameraOptions

if __name__ == "__main__":
    run_node(CameraOptions, run_camera)
