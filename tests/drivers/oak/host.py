"""Sources on the host in place of the device's: nodes that send given messages."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import depthai as dai
import numpy as np

from semantic_mapper.drivers.live import LiveCamera
from semantic_mapper.drivers.oak.camera import open_camera
from semantic_mapper.drivers.oak.config import Config
from semantic_mapper.drivers.oak.device import OdometryPorts, Sources
from semantic_mapper.types import Float64

WIDTH, HEIGHT, FPS = 64, 48, 50.0
PERIOD = timedelta(seconds=1 / FPS)
CONFIG = Config(width=WIDTH, height=HEIGHT, fps=FPS)
SOCKETS = dai.CameraBoardSocket
FOCAL, BASE_WIDTH, BASE_HEIGHT = 1000.0, 1280, 960  # of the calibration: twenty times the images
RGB_IN_LEFT_CM = (3.75, 0.5, -0.25)
NAME = "OAK of the tests"


def write_calibration(path: Path) -> Path:
    """A calibration as DepthAI stores it: colour at CAM_A, the pair at CAM_B and CAM_C."""
    calibration = dai.CalibrationHandler()
    calibration.setBoardInfo("OAK-D", "R1")
    K = [[FOCAL, 0.0, 650.0], [0.0, FOCAL + 20, 470.0], [0.0, 0.0, 1.0]]
    for socket in (SOCKETS.CAM_A, SOCKETS.CAM_B, SOCKETS.CAM_C):
        calibration.setCameraIntrinsics(socket, K, BASE_WIDTH, BASE_HEIGHT)
        calibration.setDistortionCoefficients(socket, [0.1] * 14)
    eye = np.eye(3).tolist()
    calibration.setCameraExtrinsics(SOCKETS.CAM_A, SOCKETS.CAM_B, eye, list(RGB_IN_LEFT_CM), list(RGB_IN_LEFT_CM))
    calibration.setCameraExtrinsics(SOCKETS.CAM_B, SOCKETS.CAM_C, eye, [-7.5, 0.0, 0.0], [-7.5, 0.0, 0.0])
    assert calibration.eepromToJsonFile(path)
    return path


def rgb_image(k: int) -> np.ndarray:
    """Colours of image ``k``, RGB: red on the left, blue on the right, some green that tells its number."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:, : WIDTH // 2, 0] = 200
    image[:, WIDTH // 2 :, 2] = 200
    image[:, :, 1] = 8 * (k % 32)
    return image


def depth_image(k: int) -> np.ndarray:
    """Depth of image ``k`` in millimetres: rises from left to right and from row to row, with a hole."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    depth = (1000 + 10 * u + 100 * v + k).astype(np.uint16)
    depth[0, 0], depth[0, 1] = 0, 65535
    return depth


def stamped(frame: dai.ImgFrame, k: int, start: timedelta) -> dai.ImgFrame:
    frame.setSequenceNum(k)
    frame.setTimestamp(start + k * PERIOD)
    frame.setTimestampDevice(start + k * PERIOD)
    return frame


def rgb_message(k: int, start: timedelta, kind: Any = dai.ImgFrame.Type.NV12) -> dai.ImgFrame:
    frame = dai.ImgFrame()
    frame.setCvFrame(np.ascontiguousarray(rgb_image(k)[:, :, ::-1]), kind)
    return stamped(frame, k, start)


def depth_message(k: int, start: timedelta) -> dai.ImgFrame:
    frame = dai.ImgFrame()
    frame.setCvFrame(depth_image(k), dai.ImgFrame.Type.RAW16)
    return stamped(frame, k, start)


def long_ago(count: int) -> timedelta:
    """A start for this many stamps that the last of them is past."""
    return dai.Clock.now() - (count + 1) * PERIOD


class Player(dai.node.ThreadedHostNode):
    """Sends messages, then waits for the end of the pipeline, or ends it: as unplugging a device does.

    Exceptions here would end the process, so there is nothing in ``run`` that could raise but DepthAI's end of queues.
    """

    def __init__(self, messages: Sequence[dai.Buffer], *, period_s: float, ends: bool, pipeline: Any) -> None:
        super().__init__()
        self.output = self.createOutput()
        self._messages = messages
        self._period_s = period_s
        self._ends = ends
        self._pipeline = pipeline

    def run(self) -> None:
        for message in self._messages:
            if not self.isRunning():
                return
            self.output.send(message)
            time.sleep(self._period_s)
        time.sleep(0.5)  # what has been sent is read before the end
        if self._ends:
            self._pipeline.stop()


def played(
    calibration: Path,
    rgb: Sequence[dai.Buffer],
    depth: Sequence[dai.Buffer] | None,
    *,
    ends: bool = False,
    period_s: float = 0.005,
) -> Sources:
    """Sources that send these messages."""
    pipeline = dai.Pipeline(False)
    colour = pipeline.create(Player, rgb, period_s=period_s, ends=ends, pipeline=pipeline)
    outputs = {"rgb": colour.output}
    if depth is not None:
        outputs["depth"] = pipeline.create(Player, depth, period_s=period_s, ends=False, pipeline=pipeline).output
    return sources_of(pipeline, outputs, calibration)


def sources_of(pipeline: dai.Pipeline, outputs: dict[str, Any], calibration: Path) -> Sources:
    return Sources(pipeline, None, outputs, dai.CalibrationHandler(calibration), NAME, "1844301000000000")


def camera(*connections: Callable[[], Sources], config: Config = CONFIG) -> LiveCamera:
    """The driver's camera on these sources, one after the other; each may raise a ``CameraError``."""
    rest = list(connections)
    return open_camera(config, "front", connect=lambda _: rest.pop(0)())


class SlowTracker(dai.node.ThreadedHostNode):
    """Stands where BasaltVIO stands, which needs a device: answers each pair, in order, by a pose without a stamp."""

    def __init__(self, pose_of: Callable[[int], dai.Buffer], slowness_s: float) -> None:
        super().__init__()
        self.left = self.createInput()
        self.right = self.createInput()
        self.output = self.createOutput()
        self._pose_of = pose_of
        self._slowness_s = slowness_s

    def run(self) -> None:
        while self.isRunning():
            left, right = self.left.get(), self.right.get()
            if left.getSequenceNum() != right.getSequenceNum():
                return  # no poses from here on: the test fails
            time.sleep(self._slowness_s)
            self.output.send(self._pose_of(left.getSequenceNum()))


def tracked(
    sources: Sources,
    pose_of: Callable[[int], dai.Buffer],
    T_left_rgb: Float64,
    *,
    slowness_s: float = 2.2 / FPS,
    start: timedelta | None = None,
) -> Sources:
    """Sources with odometry, which says ``pose_of(k)`` of the pair ``k``, more slowly than the pairs come."""
    pipeline = sources.pipeline
    start = start or dai.Clock.now()
    pairs = [[rgb_message(k, start, dai.ImgFrame.Type.BGR888i) for k in range(100)] for _ in range(2)]
    sides = [pipeline.create(Player, side, period_s=1 / FPS, ends=False, pipeline=pipeline) for side in pairs]
    tracker = pipeline.create(SlowTracker, pose_of, slowness_s)
    pair = {"left": sides[0].output, "right": sides[1].output}
    inputs = {"left": tracker.left, "right": tracker.right}
    ports = OdometryPorts(pair, inputs, tracker.output, T_left_rgb)
    return replace(sources, odometry=ports)
