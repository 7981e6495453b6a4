"""The device's part of the pipeline: cameras, stereo depth aligned to the colour image, IMU and odometry."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np

from semantic_mapper.drivers.oak.config import Config
from semantic_mapper.drivers.oak.devices import find_device, load_depthai
from semantic_mapper.drivers.oak.stream import OdometryPorts, Sources
from semantic_mapper.errors import CameraError
from semantic_mapper.types import Float64

IMU_HZ = 200
IMU_BATCH = 10  # reports that may wait on the device; each is sent as soon as it is there
_SLOW_USB = ("LOW", "FULL", "HIGH")


def connect_device(config: Config, on_state: Callable[[str], None], search_s: float) -> Sources:
    """Open the device and build its part of the pipeline.

    Args:
        config: Of the camera.
        on_state: Called with each new state of the device, by a thread of DepthAI's: it must not raise.
        search_s: How long the device is looked for before it counts as missing.

    Raises:
        CameraError: no such device, or it cannot do what the config asks for.
    """
    dai = load_depthai()
    info = find_device(config.device, search_s)
    try:
        device = dai.Device(info)
    except RuntimeError as error:
        raise CameraError(
            f"the OAK {info.getDeviceId()} ({info.name}) cannot be opened: {error}; plug it in again, or try another "
            "cable or port"
        ) from error
    with ExitStack() as undo:
        undo.callback(_close, device)
        try:
            sources = _sources(device, config, on_state)
        except RuntimeError as error:
            raise CameraError(f"the OAK {info.getDeviceId()} does not take this configuration: {error}") from error
        undo.pop_all()
    return sources


def _close(device: Any) -> None:
    with suppress(RuntimeError):  # it has gone meanwhile: there is nothing to close
        device.close()


def load_calibration(device: Any, path: str) -> Any:
    """The ``dai.CalibrationHandler`` of a file, or of the device where ``path`` is empty.

    Raises:
        CameraError: no such file, or none of DepthAI's.
    """
    if not path:
        return device.readCalibration()
    try:
        return load_depthai().CalibrationHandler(Path(path))
    except (RuntimeError, ValueError) as error:
        raise CameraError(f"{path}: not a calibration of DepthAI's: {error}") from error


def rgb_to_left(calibration: Any, config: Config) -> Float64:
    """``T_left_rgb`` (4, 4) in metres, of a ``dai.CalibrationHandler``.

    Raises:
        CameraError: the calibration does not link the two cameras.
    """
    dai = load_depthai()
    rgb, left = (getattr(dai.CameraBoardSocket, socket) for socket in (config.rgb, config.left))
    if rgb == left:
        return np.eye(4)
    try:
        matrix = calibration.getCameraExtrinsics(rgb, left, False, dai.LengthUnit.METER)
    except RuntimeError as error:
        raise CameraError(f"the OAK's calibration does not link {config.rgb} and {config.left}: {error}") from error
    return np.array(matrix, np.float64)


def _sources(device: Any, config: Config, on_state: Callable[[str], None]) -> Sources:
    """Raises RuntimeError, too: DepthAI's."""
    dai = load_depthai()
    device.setMaxReconnectionAttempts(0)  # the camera does that itself, and can be stopped
    _check_abilities(device, config)
    calibration = load_calibration(device, config.calibration)
    pipeline = dai.Pipeline(device)
    pipeline.setStopOnDeviceLoss(True)
    pipeline.setDeviceStateCallback(lambda _, state: on_state(state.name.lower()))
    if config.calibration:
        pipeline.setCalibrationData(calibration)
    if config.ir_dots > 0:
        device.setIrLaserDotProjectorIntensity(config.ir_dots)
    rgb = _camera(pipeline, config.rgb, config).requestOutput(
        (config.width, config.height), dai.ImgFrame.Type.NV12, fps=config.fps, enableUndistortion=True
    )
    depth, odometry = None, None
    if config.depth:
        left, right = (
            _camera(pipeline, socket, config).requestOutput((config.stereo_width, config.stereo_height), fps=config.fps)
            for socket in (config.left, config.right)
        )
        depth = _aligned_depth(pipeline, device, left, right, rgb, config)
        if config.odometry:
            odometry = _odometry(pipeline, left, right, rgb_to_left(calibration, config))
    product = device.getProductName() or device.getDeviceName() or "OAK"
    return Sources(
        pipeline=pipeline,
        device=device,
        rgb=rgb,
        depth=depth,
        calibration=calibration,
        name=f"{product} {device.getDeviceId()}",
        address=config.device or device.getDeviceId(),
        metadata={"device": device.getDeviceId(), "product": str(product), "platform": device.getPlatformAsString()},
        notes=_notes(device),
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
    return OdometryPorts(
        left_out=left,
        right_out=right,
        left_in=basalt.left,
        right_in=basalt.right,
        pose_out=basalt.transform,
        T_left_rgb=T_left_rgb,
    )


def _notes(device: Any) -> tuple[str, ...]:
    usb = device.getUsbSpeed().name
    if usb in _SLOW_USB and "USB" in device.getDeviceInfo().protocol.name:
        return (f"it is connected at USB 2 speed ({usb}), too slow for its images: use a USB 3 port and cable",)
    return ()
