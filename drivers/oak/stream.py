"""Everything behind the sources of one connection: what is synced, waited for, and how it ends.

A pipeline has two parts. The sources are the device's (``device.py``), or files and nodes of the host (tests); what is
here is the same for both. No Python runs in DepthAI's own threads, where an exception would end the process.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any

from semantic_mapper.drivers.live import SLICE_S, StreamEnded
from semantic_mapper.drivers.oak.config import Config
from semantic_mapper.drivers.oak.devices import load_depthai
from semantic_mapper.errors import CameraError
from semantic_mapper.types import Float64

START_S, STALL_S = 20.0, 3.0  # without an image for so long after opening, later: it has stalled
QUEUE = 4  # images that wait where the reader is slow; the oldest gives way, which is a gap


@dataclass(frozen=True, slots=True, eq=False)
class OdometryPorts:
    """Where odometry takes its images and gives its poses."""

    # left_out, right_out: ``dai.Node.Output`` of the stereo pair.
    left_out: Any
    right_out: Any
    # left_in, right_in: ``dai.Node.Input`` of the odometry node.
    left_in: Any
    right_in: Any
    pose_out: Any  # ``dai.Node.Output`` of its poses (``dai.TransformData``), in the order of the images
    T_left_rgb: Float64  # (4, 4) from the colour camera to the left one, metres


@dataclass(frozen=True, slots=True, eq=False)
class Sources:
    """What a pipeline gets its messages from."""

    pipeline: Any  # ``dai.Pipeline`` that holds the source nodes; not started yet
    device: Any | None  # ``dai.Device`` to close at the end; None on the host alone
    # rgb, depth: ``dai.Node.Output`` of the colour images and of their depth; None without depth.
    rgb: Any
    depth: Any | None
    calibration: Any  # ``dai.CalibrationHandler`` of the device
    name: str  # what people call it; ``address``: by which it is found again
    address: str
    metadata: Mapping[str, str] = field(default_factory=dict[str, str])  # for the stream's information
    notes: tuple[str, ...] = ()  # what does not work as it should, as far as one knows at once
    odometry: OdometryPorts | None = None  # none without

    def close(self) -> None:
        """Free the device; one that has gone already is no error."""
        if self.device is not None:
            with suppress(RuntimeError):  # the link is dead: there is nothing to close
                self.device.close()


class Stream:
    """The synced images of one connection, from ``start`` to ``close``.

    Args:
        sources: Of a pipeline that is not started yet.
        config: Of the camera.

    Raises:
        CameraError: the pipeline cannot be built.
    """

    def __init__(self, sources: Sources, config: Config) -> None:
        self.sources = sources
        self._patience_s = START_S
        outputs = {"rgb": sources.rgb} if sources.depth is None else {"rgb": sources.rgb, "depth": sources.depth}
        self._groups = synced_queue(sources.pipeline, outputs, 0.5 / config.fps, QUEUE)
        self._first: tuple[Any, Any | None] | None = None
        self._heard = time.monotonic()

    def start(self) -> None:
        """Let the images come.

        Raises:
            CameraError: the device refuses the pipeline.
        """
        try:
            self.sources.pipeline.start()
        except RuntimeError as error:
            raise CameraError(
                f"{self.sources.name} does not start: {error}; try a smaller `width`, `height` or `fps`"
            ) from error
        self._heard = time.monotonic()

    def first(self, stopped: threading.Event) -> tuple[Any, Any | None] | None:
        """The first messages, which ``read`` gives once more; None where a stop comes before them.

        Raises:
            StreamEnded: as ``read``.
        """
        while self._first is None and not stopped.is_set():
            self._first = self.read(SLICE_S)
        return self._first

    def read(self, timeout_s: float) -> tuple[Any, Any | None] | None:
        """The next colour message and its depth; None where it does not come within the time.

        Raises:
            StreamEnded: the device has gone, or has given nothing for ``STALL_S`` (``START_S`` before the first).
        """
        if self._first is not None:
            messages, self._first = self._first, None
            return messages
        group = take(self._groups, timeout_s)
        now = time.monotonic()
        if group is not None:
            self._heard, self._patience_s = now, STALL_S
            return group["rgb"], None if self.sources.depth is None else group["depth"]
        if not self.sources.pipeline.isRunning():
            raise StreamEnded("it has gone (unplugged, without power, or its firmware has crashed)")
        if now - self._heard > self._patience_s:
            what = "image" if self.sources.depth is None else "image with depth"
            raise StreamEnded(f"it has given no {what} for {self._patience_s:g} s")
        return None

    def close(self) -> None:
        """Stop the pipeline and free the device; a device that has gone already is no error."""
        with suppress(RuntimeError):  # the link is dead: there is nothing to stop
            if self.sources.pipeline.isRunning():
                self.sources.pipeline.stop()
            self.sources.pipeline.wait()
        self.sources.close()


def synced_queue(pipeline: Any, outputs: Mapping[str, Any], within_s: float, size: int) -> Any:
    """Queue of groups (``dai.MessageGroup``) of messages of one moment, by the names of their outputs.

    Args:
        pipeline: ``dai.Pipeline``.
        outputs: ``dai.Node.Output`` by name.
        within_s: How far the stamps of a group may lie apart; what has no partner is left out.
        size: Groups that wait; the oldest gives way.
    """
    sync = pipeline.create(load_depthai().node.Sync)
    sync.setRunOnHost(True)
    sync.setSyncThreshold(timedelta(seconds=within_s))
    for name, output in outputs.items():
        output.link(sync.inputs[name])
    return sync.out.createOutputQueue(maxSize=size, blocking=False)


def take(queue: Any, timeout_s: float) -> Any | None:
    """The next message of a queue; None where it does not come within the time.

    Raises:
        StreamEnded: the pipeline has ended.
    """
    try:
        return queue.get(timedelta(seconds=timeout_s))
    except load_depthai().MessageQueue.QueueException as error:
        raise StreamEnded("it has gone (unplugged, without power, or its firmware has crashed)") from error
