"""A robot in a virtual machine: ``vivid`` shows a film to its own camera, and the camera node publishes it with poses.

``vivid`` has an output (what a monitor's cable is plugged into) and a camera whose cable ends there. This program shows
a picture after the other at the output, tells on the pose topic where the robot is, and runs the camera node, which
knows nothing of all that. Run in the guest by ``v4l2_map.py``; no torch, since importing it over the shared file system
would take minutes.
"""

from __future__ import annotations

import fcntl
import json
import mmap
import signal
import struct
import subprocess
import sys
import time
import types
from pathlib import Path
from typing import NamedTuple

sys.modules["torch"] = types.ModuleType("torch")  # the library names its types, the camera node uses nothing of it

import numpy as np  # noqa: E402
import zmq  # noqa: E402

from semantic_mapper.drivers.v4l2 import ioctls, paths  # noqa: E402
from semantic_mapper.transport.messages import Status  # noqa: E402
from semantic_mapper.transport.pose_message import PoseMessage, encode_pose  # noqa: E402
from semantic_mapper.transport.sockets import LosslessSubscriber  # noqa: E402

POSES = "tcp://127.0.0.1:5560"
HEARTBEAT_S = 0.05  # between two poses
LAST_S = 1.0  # that the last picture stays
SWITCH_NS = 1000  # between the last pose of a picture and the first of the next
AHEAD = 8  # pictures that the robot may go on before the status says what was published meanwhile
BUFFERS = 3

# Layouts and numbers of linux/videodev2.h on 64 bit machines.
BUF_TYPE_OUTPUT, MEMORY_MMAP, FIELD_NONE, COLORSPACE_SRGB = 2, 1, 1, 8
BUFFER_SIZE, FORMAT_SIZE, TIMINGS_SIZE = 88, 208, 132
# 640x480 at 59.94 Hz: size, progressive, polarities, pixel clock, porches and syncs, standards (CEA-861, DMT).
VGA = struct.pack("=IIIIIQ9II", 0, 640, 480, 0, 0, 25_175_000, 16, 96, 48, 10, 2, 33, 0, 0, 0, 3)


def _request(direction: int, number: int, size: int) -> int:
    return direction << 30 | size << 16 | ord("V") << 8 | number


S_FMT, REQBUFS, QUERYBUF = _request(3, 5, FORMAT_SIZE), _request(3, 8, 20), _request(3, 9, BUFFER_SIZE)
QBUF, DQBUF, STREAMON = _request(3, 15, BUFFER_SIZE), _request(3, 17, BUFFER_SIZE), _request(1, 18, 4)
S_DV_TIMINGS = _request(3, 87, TIMINGS_SIZE)


class Film(NamedTuple):
    """Pictures (N, bytes) as YUYV, how many are shown a second and a published frame at most, and the camera's
    positions and quaternions (x y z w)."""

    pictures: np.ndarray
    hz: float
    a_frame: int
    positions: list[list[float]]
    quaternions: list[list[float]]


class Output:
    """The output of ``vivid``: what was queued last is shown until the next picture comes.

    Args:
        path: Of its device.
        first: Picture that is shown at first.
    """

    def __init__(self, path: Path, first: bytes) -> None:
        self._file = path.open("r+b", buffering=0)
        size = len(first)
        pixels = struct.pack("=II4s5I", 640, 480, b"YUYV", FIELD_NONE, 1280, size, COLORSPACE_SRGB, 0)
        self._ask(S_FMT, struct.pack("=II", BUF_TYPE_OUTPUT, 0) + pixels, FORMAT_SIZE)
        self._ask(REQBUFS, struct.pack("=III", BUFFERS, BUF_TYPE_OUTPUT, MEMORY_MMAP), 20)
        self._buffers = [self._map(index) for index in range(BUFFERS)]
        self._free = list(range(BUFFERS))
        self._queue(first)
        fcntl.ioctl(self._file, STREAMON, struct.pack("=i", BUF_TYPE_OUTPUT))

    def show(self, picture: bytes) -> int:
        """Show another picture; returns the moment of the change on the monotonic clock, in nanoseconds.

        A picture of the camera with an earlier stamp shows what was there before, one from then on shows this one.
        """
        self._queue(picture)
        told = self._ask(DQBUF, self._buffer(0), BUFFER_SIZE)
        (index,) = struct.unpack_from("=I", told, 0)
        seconds, microseconds = struct.unpack_from("=qq", told, 24)
        self._free.append(index)
        return seconds * 1_000_000_000 + microseconds * 1000

    def _queue(self, picture: bytes) -> None:
        index = self._free.pop(0)
        self._buffers[index][: len(picture)] = picture
        self._ask(QBUF, self._buffer(index, len(picture)), BUFFER_SIZE)

    def _map(self, index: int) -> mmap.mmap:
        told = self._ask(QUERYBUF, self._buffer(index), BUFFER_SIZE)
        (offset,) = struct.unpack_from("=I", told, 64)
        (length,) = struct.unpack_from("=I", told, 72)
        return mmap.mmap(self._file.fileno(), length, offset=offset)

    @staticmethod
    def _buffer(index: int, used: int = 0) -> bytes:
        return struct.pack("=5I40xI", index, BUF_TYPE_OUTPUT, used, 0, FIELD_NONE, MEMORY_MMAP)

    def _ask(self, request: int, data: bytes, size: int) -> bytearray:
        told = bytearray(data.ljust(size, b"\0"))
        fcntl.ioctl(self._file, request, told, True)
        return told


def connect_cable() -> tuple[Path, Path]:
    """Both ends of the cable at 640x480, the camera's at the output: camera and output."""
    nodes = {}
    for node in paths.video_nodes():
        with ioctls.opened(node) as fd:
            nodes[ioctls.query_capability(fd).captures] = node
            fcntl.ioctl(fd, S_DV_TIMINGS, bytearray(VGA.ljust(TIMINGS_SIZE, b"\0")), True)
    with ioctls.opened(nodes[True]) as fd:
        controls = ioctls.list_controls(fd)
        ioctls.set_control(fd, controls["osd_text_mode"].id, 2)  # no text over the picture
        ioctls.set_control(fd, controls["loop_video"].id, 1)
        # At the moment when the picture is taken; else most of a frame's time is added, in which it may have changed.
        ioctls.set_control(fd, controls["timestamp_source"].id, 1)
    return nodes[True], nodes[False]


class Robot:
    """Walks through the film, and tells where it is.

    Args:
        film: What it sees and where.
        output: Shows it.
        status: What the camera node says about itself.
    """

    def __init__(self, film: Film, output: Output, status: LosslessSubscriber) -> None:
        self._film = film
        self._output = output
        self._status = status
        self._published = 0  # frames of the camera node
        self._poses = zmq.Context.instance().socket(zmq.PUB)
        self._poses.bind(POSES)

    def walk(self) -> None:
        """Stand at the first picture until the camera node has published, then go to the last one.

        It goes no faster than the camera publishes: an emulated processor is slow, on a busy machine very slow.
        """
        while not self._published:
            self._stand(0, HEARTBEAT_S)
        began, first = time.monotonic(), self._published
        for index in range(1, len(self._film.pictures)):
            self._stand(index - 1, 1 / self._film.hz)
            while index > AHEAD + self._film.a_frame * (self._published - first):
                self._stand(index - 1, HEARTBEAT_S)
            stamp_ns = self._output.show(self._film.pictures[index].tobytes())
            self._tell(stamp_ns - SWITCH_NS, index - 1)
            self._tell(stamp_ns, index)
        self._stand(len(self._film.pictures) - 1, LAST_S)
        print(f"guest: {len(self._film.pictures)} pictures shown in {time.monotonic() - began:.0f} s", flush=True)

    def _stand(self, index: int, seconds: float) -> None:
        """Stay at a picture."""
        until = time.monotonic() + seconds
        while (left_s := until - time.monotonic()) > 0:
            self._tell(time.monotonic_ns(), index)
            message = self._status.receive(min(HEARTBEAT_S, left_s))
            if isinstance(message, Status):
                self._published = message.counters.get("published", 0)

    def _tell(self, stamp_ns: int, index: int) -> None:
        position, quaternion = tuple(self._film.positions[index]), tuple(self._film.quaternions[index])
        message = PoseMessage(stamp_ns=stamp_ns, position=position, quaternion=quaternion)
        self._poses.send_multipart(encode_pose(message))


def main() -> int:
    """Exit code of the camera node."""
    if sys.argv[1] == "camera":
        from semantic_mapper.nodes.camera.node import main as run_camera
        from semantic_mapper.nodes.node import read_job

        run_camera(read_job(sys.argv[2]))
    settings = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    film = Film(np.load(settings["pictures"], mmap_mode="r"), **settings["walk"])
    camera, output = connect_cable()
    job = settings["job"]
    job["options"]["camera"]["config"]["device"] = str(camera)
    job["options"]["camera"]["poses"]["endpoint"] = POSES
    shown = Output(output, film.pictures[0].tobytes())
    with (
        subprocess.Popen([sys.executable, __file__, "camera", json.dumps(job)]) as node,
        LosslessSubscriber(job["endpoints"]["camera"], ("status",)) as status,
    ):
        try:
            Robot(film, shown, status).walk()
        finally:
            node.send_signal(signal.SIGINT)
        return node.wait()


if __name__ == "__main__":
    sys.exit(main())
