"""What a pipeline on an OAK gives: colour, stereo depth aligned to it, IMU and odometry; and what they say of it.

A pipeline has two parts: its sources are the device's, or files and nodes of the host (tests); what is behind them is
the same. No Python runs in DepthAI's own threads, where an exception would end the process.
"""

import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np

from semantic_mapper.drivers.base import as_camera_error
from semantic_mapper.drivers.oak.config import Config
from semantic_mapper.drivers.oak.devices import find_device, load_depthai
from semantic_mapper.errors import CameraError
from semantic_mapper.types import Float64

IMU_HZ = 200
IMU_BATCH = 10  # reports that may wait on the device; each is sent as soon as it is there
_SLOW_USB = ("LOW", "FULL", "HIGH")
_CLOCK_READINGS = 5


@dataclass(frozen=True, slots=True, eq=False)
class OdometryPorts:
    """Where odometry takes its images and gives its poses."""

    pair: Mapping[str, Any]  # "left" and "right": ``dai.Node.Output`` of the stereo pair
    inputs: Mapping[str, Any]  # "left" and "right": ``dai.Node.Input`` of the odometry node
    pose_out: Any  # ``dai.Node.Output`` of its poses (``dai.TransformData``), in the order of the images
    T_left_rgb: Float64  # (4, 4) from the colour camera to the left one, metres


@dataclass(frozen=True, slots=True, eq=False)
class Sources:
    """What a pipeline gets its messages from."""

    pipeline: Any  # ``dai.Pipeline`` that holds the source nodes; not started yet
    device: Any | None  # ``dai.Device`` to close at the end; None on the host alone
    outputs: Mapping[str, Any]  # ``dai.Node.Output`` of colour ("rgb") and, where there is depth, of "depth"
    calibration: Any  # ``dai.CalibrationHandler`` of the device
    name: str  # what people call it; ``address``: by which it is found again
    address: str
    metadata: Mapping[str, str] = field(default_factory=dict[str, str])  # for the stream's information
    notes: tuple[str, ...] = ()  # what does not work as it should, as far as one knows at once
    odometry: OdometryPorts | None = None  # none without

    def close(self) -> None:
        """Stop the pipeline and free the device; one that has gone already is no error."""
        with suppress(RuntimeError):  # the link is dead: there is nothing to stop
            if self.pipeline.isRunning():
                self.pipeline.stop()
            self.pipeline.wait()
        if self.device is not None:
            with suppress(RuntimeError):
                self.device.close()


def connect_device(config: Config) -> Sources:
    """Open the device and build its part of the pipeline; ``CameraError``: without one, or where it cannot do that."""
    info = find_device(config.device)
    name = f"the OAK {info.getDeviceId()} ({info.name})"
    with as_camera_error(f"{name} cannot be opened", "plug it in again, or try another cable or port", RuntimeError):
        device = load_depthai().Device(info)
    fix = "check the settings of the camera, and the calibration that is stored on it"
    with ExitStack() as undo, as_camera_error(f"{name} does not take this configuration", fix, RuntimeError):
        undo.callback(device.close)
        sources = _sources(device, config)
        undo.pop_all()
    return sources


def load_calibration(device: Any, path: str) -> Any:
    """The ``dai.CalibrationHandler`` of a file (``CameraError``: it is another file), or of the device without one."""
    if not path:
        return device.readCalibration()
    with as_camera_error(path, "give a calibration as DepthAI writes it (JSON)", RuntimeError, ValueError):
        return load_depthai().CalibrationHandler(Path(path))


def rgb_to_left(calibration: Any, config: Config) -> Float64:
    """``T_left_rgb`` (4, 4) in metres, of a ``dai.CalibrationHandler``; DepthAI's error where it does not link them."""
    dai = load_depthai()
    rgb, left = (getattr(dai.CameraBoardSocket, socket) for socket in (config.rgb, config.left))
    if rgb == left:
        return np.eye(4)
    return np.array(calibration.getCameraExtrinsics(rgb, left, False, dai.LengthUnit.METER), np.float64)


def _sources(device: Any, config: Config) -> Sources:
    dai = load_depthai()
    device.setMaxReconnectionAttempts(0)  # the camera does that itself, and can be stopped
    _check_abilities(device, config)
    calibration = load_calibration(device, config.calibration)
    pipeline = dai.Pipeline(device)
    pipeline.setStopOnDeviceLoss(True)
    if config.calibration:
        pipeline.setCalibrationData(calibration)
    if config.ir_dots > 0:
        device.setIrLaserDotProjectorIntensity(config.ir_dots)
    rgb = _camera(pipeline, config.rgb, config).requestOutput(
        (config.width, config.height), dai.ImgFrame.Type.NV12, fps=config.fps, enableUndistortion=True
    )
    outputs, odometry = {"rgb": rgb}, None
    if config.depth:
        left, right = (
            _camera(pipeline, socket, config).requestOutput((config.stereo_width, config.stereo_height), fps=config.fps)
            for socket in (config.left, config.right)
        )
        outputs["depth"] = _aligned_depth(pipeline, device, left, right, rgb, config)
        if config.odometry:
            odometry = _odometry(pipeline, left, right, rgb_to_left(calibration, config))
    usb, notes = device.getUsbSpeed().name, ()
    if usb in _SLOW_USB and "USB" in device.getDeviceInfo().protocol.name:
        notes = (f"it is connected at USB 2 speed ({usb}), too slow for its images: use a USB 3 port and cable",)
    product = device.getProductName() or device.getDeviceName() or "OAK"
    return Sources(
        pipeline=pipeline,
        device=device,
        outputs=outputs,
        calibration=calibration,
        name=f"{product} {device.getDeviceId()}",
        address=config.device or device.getDeviceId(),
        metadata={"device": device.getDeviceId(), "product": str(product), "platform": device.getPlatformAsString()},
        notes=notes,
        odometry=odometry,
    )


def _check_abilities(device: Any, config: Config) -> None:
    there = [socket.name for socket in device.getConnectedCameras()]
    needed = [config.rgb, config.left, config.right] if config.depth else [config.rgb]
    absent = [socket for socket in needed if socket not in there]
    if absent:
        raise CameraError(
            f"the OAK {device.getDeviceId()} has no camera at {', '.join(absent)}, but at {', '.join(there)}: set "
            "`rgb`, `left` and `right`, or `depth = false` for a board without a stereo pair"
        )
    if config.odometry and device.getConnectedIMU() in ("", "NONE"):
        raise CameraError(f"the OAK {device.getDeviceId()} has no IMU, which odometry needs: set `odometry = false`")


def _camera(pipeline: Any, socket: str, config: Config) -> Any:
    """The camera at a socket, made once: the colour camera may be one of the pair."""
    dai = load_depthai()
    board_socket = getattr(dai.CameraBoardSocket, socket)
    for node in pipeline.getAllNodes():
        if isinstance(node, dai.node.Camera) and node.getBoardSocket() == board_socket:
            return node
    return pipeline.create(dai.node.Camera).build(board_socket, sensorFps=config.fps)


def _aligned_depth(pipeline: Any, device: Any, left: Any, right: Any, rgb: Any, config: Config) -> Any:
    """Output of depth in the pixels of the colour image; the two generations of boards align in different nodes."""
    dai = load_depthai()
    stereo = pipeline.create(dai.node.StereoDepth)
    stereo.setDefaultProfilePreset(getattr(dai.node.StereoDepth.PresetMode, config.stereo_preset.upper()))
    stereo.setLeftRightCheck(True)
    stereo.setSubpixel(True)
    left.link(stereo.left)
    right.link(stereo.right)
    if device.getPlatform() == dai.Platform.RVC4:
        align = pipeline.create(dai.node.ImageAlign)
        stereo.depth.link(align.input)
        rgb.link(align.inputAlignTo)
        return align.outputAligned
    rgb.link(stereo.inputAlignTo)
    return stereo.depth


def _odometry(pipeline: Any, left: Any, right: Any, T_left_rgb: Float64) -> OdometryPorts:
    dai = load_depthai()
    imu = pipeline.create(dai.node.IMU)
    imu.enableIMUSensor([dai.IMUSensor.ACCELEROMETER_RAW, dai.IMUSensor.GYROSCOPE_RAW], IMU_HZ)
    imu.setBatchReportThreshold(1)
    imu.setMaxBatchReports(IMU_BATCH)
    basalt = pipeline.create(dai.node.BasaltVIO)
    basalt.runSyncOnHost(True)  # its images come from the host, see ``odometry.py``
    basalt.setImuUpdateRate(IMU_HZ)
    imu.out.link(basalt.imu)
    inputs = {"left": basalt.left, "right": basalt.right}
    return OdometryPorts({"left": left, "right": right}, inputs, basalt.transform, T_left_rgb)


def synced_queue(pipeline: Any, outputs: Mapping[str, Any], within_s: float, size: int) -> Any:
    """Queue of up to ``size`` groups (``dai.MessageGroup``) of messages by the names of their ``dai.Node.Output``, with
    stamps so far apart at most; what has no partner is left out, and the oldest group gives way."""
    sync = pipeline.create(load_depthai().node.Sync)
    sync.setRunOnHost(True)
    sync.setSyncThreshold(timedelta(seconds=within_s))
    for name, output in outputs.items():
        output.link(sync.inputs[name])
    return sync.out.createOutputQueue(maxSize=size, blocking=False)


def take(queue: Any, timeout_s: float) -> Any | None:
    """The next message of a queue; None where it does not come within the time; ``EOFError``: it has ended."""
    try:
        return queue.get(timedelta(seconds=timeout_s))
    except load_depthai().MessageQueue.QueueException as error:
        raise EOFError from error


def to_ns(moment: timedelta) -> int:
    """A DepthAI time in nanoseconds, exactly."""
    return moment // timedelta(microseconds=1) * 1000


def clock_offset_ns() -> int:
    """What to add to a time of DepthAI's host clock to have one of this machine's monotonic clock."""
    clock = load_depthai().Clock
    return max(time.monotonic_ns() - to_ns(clock.now()) for _ in range(_CLOCK_READINGS))


def capture_ns(frame: Any, offset_ns: int) -> int:
    """When the middle of an image was exposed, on this machine's monotonic clock.

    DepthAI keeps the device's clock in step with the host's; ``offset_ns`` is that of ``clock_offset_ns``.
    """
    return to_ns(frame.getTimestamp(load_depthai().CameraExposureOffset.MIDDLE)) + offset_ns
