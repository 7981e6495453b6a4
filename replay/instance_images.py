"""Images of things, as ``autolabel --instances`` writes them: ``CAMERA/NNNNNN.png`` and ``instances.json``."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from semantic_mapper.errors import LogError
from semantic_mapper.fields.scene.panoptic import Panoptic
from semantic_mapper.files import write_bytes, write_json
from semantic_mapper.rays import pixel_grid, pixel_rays
from semantic_mapper.types import PosedFrame, UInt8

RAYS = 4096  # rendered at once
FILE = "instances.json"


class InstanceImages:
    """Writes a folder of images of things: uint16 ids of boxes, 0 = none; nothing is in it before ``finish``.

    ``instances.json`` has each thing's id, class, box, and pixels by frame ("CAMERA/NNNNNN").

    Args:
        folder: New, or of an earlier run, whose images of the same frames are replaced.
        field: Whose boxes they are of.

    Raises:
        LogError: the folder cannot be made.
    """

    def __init__(self, folder: Path, field: Panoptic) -> None:
        self._folder, self._field = folder, field
        self._pixels: dict[int, dict[str, int]] = {b.id: {} for b in field.shape.boxes if b.thing}
        self._new = not folder.exists()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._unfinished = Path(tempfile.mkdtemp(prefix=".unfinished-", dir=folder))
        except OSError as error:
            raise LogError(f"{folder}: cannot be made: {error.strerror or error}") from error

    def add(self, number: int, frame: PosedFrame, label: UInt8) -> None:
        """Write the things of a frame.

        Args:
            number: Of the frame in its log.
            frame: Pose and camera, and measured depth.
            label: (H, W) ids of the field's label set: a thing is where its class is.

        Raises:
            LogError: it cannot be written.
        """
        ids = thing_image(self._field, frame, label)
        name = f"{frame.camera_id}/{number:06d}"
        path = self._unfinished / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, cv2.imencode(".png", ids)[1].tobytes(), raises=LogError)
        for thing, count in zip(*np.unique(ids[ids > 0], return_counts=True), strict=True):
            self._pixels[int(thing)][name] = int(count)

    def finish(self) -> None:
        """Put all images in place, then the list of things.

        Raises:
            LogError: they cannot be written.
        """
        things: list[dict[str, Any]] = [
            {"id": b.id, "class": b.class_name, "box": msgspec.to_builtins(b), "pixels": self._pixels[b.id]}
            for b in self._field.shape.boxes
            if b.thing
        ]
        try:
            for image in sorted(self._unfinished.rglob("*.png")):
                place = self._folder / image.relative_to(self._unfinished)
                place.parent.mkdir(parents=True, exist_ok=True)
                image.replace(place)
            write_json(self._folder / FILE, {"instances": things})
        except OSError as error:
            raise LogError(f"{self._folder}: cannot be written: {error.strerror or error}") from error

    def close(self) -> None:
        """Remove what was not finished, and the folder if it is new and empty."""
        shutil.rmtree(self._unfinished, ignore_errors=True)
        if self._new and not any(self._folder.iterdir()):
            self._folder.rmdir()


def thing_image(field: Panoptic, frame: PosedFrame, label: UInt8) -> NDArray[np.uint16]:
    """Ids (H, W) of the boxes of things that a frame sees, where its ``label`` (H, W) has their class."""
    channel = field.label_set.to_channels(label, f"frame seq={frame.seq}").ravel()
    names = field.label_set.names
    boxed = [names.index(b.class_name) for b in field.shape.boxes if b.thing]
    requested = torch.from_numpy(np.flatnonzero(np.isin(channel, boxed)))
    k, found = frame.intrinsics, np.zeros(label.size, np.uint16)
    depth = np.zeros(label.size, np.float32) if frame.depth_m is None else frame.depth_m.ravel()
    pose = torch.from_numpy(frame.T_world_camera).float()
    pixels, near_m = pixel_grid(k.width, k.height), field.sampling.near_m
    with torch.no_grad():
        for part in requested.split(RAYS):
            prior = torch.from_numpy(depth[part.numpy()])
            at = {"near_m": near_m, "far_m": field.sampling.far_m, "stamp_ns": frame.stamp_ns}
            rays = pixel_rays(pixels[part], k, pose, **at, prior_depth_m=prior)
            found[part.numpy()] = field.instances(rays, torch.from_numpy(channel[part.numpy()])).numpy()
    return found.reshape(label.shape)
