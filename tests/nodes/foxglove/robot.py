"""A robot as Foxglove sees it: a camera's and a mapper's topics, and the questions about a known map."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from semantic_mapper.nodes.foxglove.node import run_foxglove
from semantic_mapper.nodes.mapper.query_service import QueryService
from semantic_mapper.nodes.options import FoxgloveOptions
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.keys import Keys
from semantic_mapper.transport.messages import EndOfStream, Status
from semantic_mapper.transport.sockets import Publisher
from semantic_mapper.types import CameraIntrinsics, Float64, MapUpdate, PosedFrame
from tests.nodes.mapper.test_query_service import a_folder, answering
from tests.nodes.support import NodeHere, node_here
from tests.queries.scene import LABELS, whole_map
from tests.small import tiny_frames

WARM_S = 240.0  # a service may compile kernels before it answers
REFRESH_S = 0.1


def update_for(frame: PosedFrame, label: int) -> MapUpdate:
    """What a mapper would have rendered."""
    size = frame.rgb.shape[:2]
    images = np.full(size, label, np.uint8), np.ones(size, np.float32), np.ones(size, np.float32)
    moving = np.zeros(size, np.bool_)
    moving[:2] = True
    names = frame.stamp_ns, frame.seq, frame.camera_id
    return MapUpdate(*names, True, False, (), *images, blocks=1, blocks_touched=1, moving=moving)


def big_frame() -> PosedFrame:
    """Black, with 4 MB of depth."""
    lens, size = CameraIntrinsics(500.0, 500.0, 499.5, 499.5, 1000, 1000), (1000, 1000)
    rgb, depth_m = np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32)
    return dataclasses.replace(tiny_frames()[0], rgb=rgb, depth_m=depth_m, label=None, intrinsics=lens)


@dataclass(slots=True)
class Robot:
    """What a test may do to it."""

    camera: Publisher
    mapper: Publisher
    bridge: NodeHere
    endpoints: dict[str, str]
    world: int = 0  # of the camera's frames
    T_map_world: Float64 | None = field(default_factory=lambda: np.eye(4))  # None: its frames are held

    @contextmanager
    def mapped(self, keys: Keys | None = None) -> Iterator[QueryService]:
        """The mapper answers questions meanwhile."""
        with answering(self.endpoints["query"], whole_map(), keys) as service:
            yield service

    def publish(self, number: int) -> PosedFrame:
        """One more frame, with what was rendered for it, and the mapper's status."""
        frame = tiny_frames()[number]
        self.camera.publish(encode_frame(dataclasses.replace(frame, world=self.world)))
        if self.T_map_world is not None:
            update = dataclasses.replace(
                update_for(frame, LABELS.ids[1]), world=self.world, T_map_world=self.T_map_world
            )
            self.mapper.publish(encode(update))
        self.mapper.publish(encode(Status("mapper", "running", frame.stamp_ns, {"fused": number, "moving": 7})))
        return frame

    def end(self) -> None:
        """The stream of frames ends."""
        self.camera.publish(encode(EndOfStream("camera", "end", 1)))


@contextmanager
def bridged_robot(options: FoxgloveOptions) -> Iterator[Robot]:
    """A robot whose bridge is at work, in a thread of its own."""
    with a_folder() as folder:
        endpoints = {one: f"ipc://{folder / one}" for one in ("camera", "mapper", "query", "foxglove")}
        with (
            Publisher(endpoints["camera"]) as camera,
            Publisher(endpoints["mapper"]) as mapper,
            node_here(run_foxglove, "foxglove", endpoints, options) as bridge,
        ):
            for publisher, topic in ((camera, "frame"), (mapper, "map"), (mapper, "status")):
                publisher.wait_for_subscribers(topic, timeout_s=WARM_S)
            yield Robot(camera, mapper, bridge, endpoints)
