"""ROS bags of version 1 (``.bag``) and 2 (folder, ``.mcap`` or ``.db3``), read without ROS.

A frame is a colour image with the depth image nearest in time and its pose. Poses come from tf, from the world (map,
world or odom) to the frame that the image names, interpolated between the neighbours of each transform; or from a
topic of odometry or poses, whose body tf then links to the camera. Topics are found by the type of their messages.

Depth that is not registered to colour is registered here, by the two cameras' intrinsics and tf. Lens distortion is
removed where the camera's calibration tells of it and its images are not rectified already.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import semantic_mapper.replay.importers.ros_images as ros_images
from semantic_mapper.drivers.calibration import Rectifier
from semantic_mapper.errors import CodecError, ConfigError, DependencyError, ImportSourceError, SemanticMapperError
from semantic_mapper.geometry import invert_pose, scale_intrinsics, transform, unproject
from semantic_mapper.plain_text import counted, visible
from semantic_mapper.replay.importers.base import (
    BadFrameError,
    DepthScale,
    ImportOptions,
    LoadedFrame,
    check_frame_pose,
    image_size_must_be,
    same_view,
)
from semantic_mapper.replay.importers.posed import KEPT_RECTIFIERS
from semantic_mapper.replay.importers.ros_files import readable_bag
from semantic_mapper.replay.importers.ros_transforms import (
    WORLD_FRAMES,
    Track,
    TransformTree,
    fill_stamps,
    frame_name,
    pose_row,
    stamp_of,
)
from semantic_mapper.replay.importers.tum import match_nearest
from semantic_mapper.transport.codec import EncodedImage
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import MAX_STAMP_NS, CameraIntrinsics, Float32, Float64, PosedFrame, UInt8

ROLES = ("image", "depth", "info", "depth_info", "pose")
DEPTH_SCALE = DepthScale(ros_images.UNITS_PER_M, convention="ROS's millimetres (16UC1) or metres (32FC1)")
LISTED = 12  # topics that an error names
LOOKED_AT = 100  # messages of a topic until one tells what it is

_RAW, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO = "sensor_msgs/msg/CameraInfo"
_TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
# What gives the pose of a frame that it names, and what gives one without saying whose.
_NAMED_POSES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped")
_POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_SAME_PLACE = 1e-6  # of a transform's entries; cameras that are closer are one
_SAME_LENS = (
    0.005  # fraction of the focal length, and of the width, that two calibrations of one lens differ by at most
)
_FOCAL_CHANGE, _CENTRE_CHANGE = 1e-4, 0.1  # fraction, and pixels, from which an image gets a calibration of its own
_REALSENSE_VIEWER = "/device_"  # begins the topics of its recordings
_TRANSPORTS = ("/compressedDepth", "/compressed")
_VIEWER = (
    ". Recordings of the RealSense Viewer have none: record with ROS and an odometry, or live with `semantic-mapper "
    "up` of a launch file with a camera of kind realsense, which finds poses"
)
_REPAIR = (
    "`ros2 bag reindex`, `mcap recover` or `rosbag reindex` repairs a bag whose recorder was killed; one that was "
    "copied in part has to be copied again"
)


@dataclass(frozen=True, slots=True)
class _Topic:
    """A topic of images.

    Args:
        name: Of the topic; ``encoding``: of its first message with data.
        raw: ``sensor_msgs/Image``, not compressed.
        frame: Of the first message that names one; ``frame_late``: that is not the first.
    """

    name: str
    raw: bool
    encoding: str
    frame: str
    frame_late: bool = False

    @property
    def rectified(self) -> bool:
        """Whether its images have no lens distortion any more."""
        return re.search(r"(^|_)rect(_|$)|rectified", self.base.rsplit("/", 1)[-1]) is not None

    @property
    def base(self) -> str:
        """Name without the transport."""
        for transport in _TRANSPORTS:
            if not self.raw and self.name.endswith(transport):
                return self.name.removesuffix(transport)
        return self.name

    def __str__(self) -> str:
        return f"{self.name} ({visible(self.encoding)})"


class RosbagRecording:
    """A bag, opened; one frame for each image of one camera.

    Args:
        src: ``.bag``, ``.mcap`` or ``.db3`` file, or folder of ROS 2.
        options: See ``ImportOptions``.

    Raises:
        ImportSourceError: damaged, no image, several cameras where none is named, no calibration, or no poses.
        DependencyError: the package ``rosbags`` is not installed.
    """

    def __init__(self, src: Path, options: ImportOptions) -> None:
        self.notices: list[str] = []
        self.depth_scale = DEPTH_SCALE
        self._options = options
        unknown = sorted(set(options.topics) - set(ROLES))
        if unknown:
            raise ImportSourceError(f"no topic has the role '{unknown[0]}'; the roles are {', '.join(ROLES)}")
        self._bag = _Bag(src)
        color, depth = self._find_images()
        self._refuse_no_poses(color)
        if depth is not None and (units := self._bag.depth_units(depth.name)):
            self.depth_scale = DepthScale(units, src)
        infos = {color.name: self._info_topic(color, options.topics.get("info", ""))}
        depth_info = options.topics.get("depth_info", "")
        if depth is not None and (depth_info or self._has_info(depth)):
            infos[depth.name] = self._info_topic(depth, depth_info)
        color = self._with_frame(color, infos[color.name])
        depth = depth and self._with_frame(depth, infos.get(depth.name, ""))
        self._color_topic = color
        self._tree = TransformTree()
        self._stamps: dict[str, list[tuple[int, int]]] = {t.name: [] for t in (color, depth) if t is not None}
        self._first_image: dict[str, Any] = {}  # of each of these topics
        calibrations, poses = self._read_all({*infos.values(), *self._bag.topics(_INFO)})
        self._color = self._stamps[color.name]
        lenses = self._intrinsics(color, calibrations[infos[color.name]], infos[color.name])
        self._lens_stamps, self._lenses = _distinct(lenses)
        self._measured = lenses[0][1]
        if len(set(self._lenses)) > 1:
            self.notices.append(f"the calibration of {color.name} changes a little: each image has the nearest in time")
        self._T_frame_image = self._image_pose(color, calibrations[infos[color.name]])
        if "info" not in options.topics:
            self._refuse_contradictions(color, infos[color.name], calibrations)
        self._rectifiers: dict[CameraIntrinsics, Rectifier] = {}
        self._depth_topic = depth
        self._depth = self._stamps[depth.name] if depth is not None else []
        self._T_color_depth: Float64 | None = None
        self._depth_intrinsics = self._measured
        if depth is not None:
            name = infos.get(depth.name, "")
            own = self._intrinsics(depth, calibrations[name], name)[0][1] if name else None
            if own is not None and not depth_info:
                self._refuse_two_lenses(depth, own, infos[color.name], name)
            self._link_depth(depth, own)
        pose_topic = self._pose_topic()
        self._pose_at, source = self._pose_source(pose_topic, poses.get(pose_topic, []))
        self.notices.append(source)
        self._check_times(pose_topic)
        if self._tree.refused:
            self.notices.append(f"{self._tree.refused} transforms of tf are left out: they hold NaN or no rotation")
        within_ns = round(options.match_s * 1e9)
        stamps, depth_stamps = (
            np.array([stamp for stamp, _ in series], np.int64) for series in (self._color, self._depth)
        )
        self._order = np.argsort(stamps, kind="stable")
        depth_order = np.argsort(depth_stamps, kind="stable")
        matches = match_nearest(stamps[self._order], depth_stamps[depth_order], within_ns)
        self._depth_of = [int(depth_order[i]) if i >= 0 else -1 for i in matches]
        self.info = StreamInfo(
            source=f"rosbag {src.resolve().stem}",
            cameras={options.camera_id: self._rectifier(self._measured).intrinsics},
            frame_count=len(self._color),
            frame_hz=_rate(stamps),
        )
        back = int((np.diff(stamps) < 0).sum())
        if back:
            self.notices.append(f"{color.name}: stamps go back {counted(back, 'time')}; images are sorted by them")

    def __len__(self) -> int:
        return len(self._color)

    def load(self, number: int) -> LoadedFrame:
        """Read one frame.

        Raises:
            BadFrameError: it cannot be used.
        """
        index = int(self._order[number])
        stamp_ns = self._color[index][0]
        where = Path(self._color_topic.name)
        if not 0 <= stamp_ns < MAX_STAMP_NS:
            raise BadFrameError(where, f"its stamp, {stamp_ns} ns, is impossible")
        if number and self._color[int(self._order[number - 1])][0] == stamp_ns:
            raise BadFrameError(where, f"a second image of {stamp_ns / 1e9:.6f} s")
        pose = self._pose_at(stamp_ns)
        if pose is None:
            raise BadFrameError(where, f"there is no pose round its time {stamp_ns / 1e9:.6f} s{self._gap(stamp_ns)}")
        measured = self._lenses[int(np.abs(self._lens_stamps - stamp_ns).argmin())]
        rectify = self._rectifier(measured)
        try:
            rgb, encoded = self._rgb(index, measured)
        except CodecError as error:
            raise BadFrameError(where, f"image of {stamp_ns / 1e9:.6f} s: {error}") from error
        return LoadedFrame(
            PosedFrame(
                stamp_ns=stamp_ns,
                seq=number,
                camera_id=self._options.camera_id,
                rgb=rgb,
                depth_m=self._depth_m(self._depth_of[number], measured),
                label=None,
                intrinsics=rectify.intrinsics,
                T_world_camera=check_frame_pose(pose, where),
            ),
            encoded,
        )

    def _rectifier(self, measured: CameraIntrinsics) -> Rectifier:
        if measured not in self._rectifiers:
            if len(self._rectifiers) >= KEPT_RECTIFIERS:
                self._rectifiers.pop(next(iter(self._rectifiers)))
            try:
                self._rectifiers[measured] = Rectifier(measured)
            except ConfigError as error:
                raise BadFrameError(self._bag.src, str(error)) from error
        return self._rectifiers[measured]

    def _rgb(self, index: int, measured: CameraIntrinsics) -> tuple[UInt8, EncodedImage | None]:
        message = self._bag.message(self._color_topic.name, self._color, index)
        encoded = None
        if self._color_topic.raw:
            rgb = ros_images.color_image(message)
        else:
            rgb, encoded = ros_images.compressed_color_image(message)
        image_size_must_be(rgb, measured, Path(self._color_topic.name))
        if measured.distorted:
            return self._rectifier(measured)(np.ascontiguousarray(rgb[..., ::-1])), None
        return rgb, encoded

    def _depth_m(self, index: int, measured: CameraIntrinsics) -> Float32 | None:
        topic = self._depth_topic
        if index < 0 or topic is None:
            return None
        where = Path(topic.name)
        try:
            message = self._bag.message(topic.name, self._depth, index)
            read = ros_images.depth_image if topic.raw else ros_images.compressed_depth_image
            depth_m = read(message, self.depth_scale.units_per_m)
        except CodecError as error:
            raise BadFrameError(where, str(error)) from error
        rectify = self._rectifier(measured)
        k = measured if self._T_color_depth is None else self._depth_intrinsics
        if depth_m.shape != (k.height, k.width):
            height, width = depth_m.shape
            if (
                self._T_color_depth is None
                and not measured.distorted
                and same_view((k.width, k.height), (width, height))
            ):
                k = scale_intrinsics(k, width, height)  # registered, and made smaller
                return register_depth(depth_m, k, np.eye(4), rectify.intrinsics)
            raise BadFrameError(
                where,
                f"the depth image is {width}x{height}, its calibration says {k.width}x{k.height}; name the one that it "
                "has (--topic depth_info=NAME), or import without depth (--topic depth=none)",
            )
        if self._T_color_depth is not None:
            return register_depth(depth_m, k, self._T_color_depth, rectify.intrinsics)
        return rectify.nearest(depth_m)

    def _find_images(self) -> tuple[_Topic, _Topic | None]:
        """The topics of colour and of depth.

        Raises:
            ImportSourceError: none or several fit, or a named one does not.
        """
        topics = self._bag.image_topics()
        depths = [t for t in topics if ros_images.is_depth(t.name, t.encoding)]
        colors = [t for t in topics if t not in depths]
        wanted = self._options.topics
        if "image" in wanted:
            color = self._named("image", colors)
        else:
            fitting = _without_doubles(colors)
            colorful = [t for t in fitting if not ros_images.is_grey(t.encoding)]
            color = self._only("image", colorful or fitting)
            left = [str(t) for t in fitting if t != color]
            if left:
                self.notices.append(f"images are those of {color.name}; there are also {', '.join(left[:LISTED])}")
        if wanted.get("depth") == "none":
            return color, None
        if "depth" in wanted:
            return color, self._named("depth", depths)
        fitting = _without_doubles(depths)
        registered = [t for t in fitting if t.frame == color.frame]
        if not fitting:
            self.notices.append("no topic has depth images: frames come without depth")
            return color, None
        return color, self._only("depth", registered or fitting)

    def _named(self, role: str, fitting: list[_Topic]) -> _Topic:
        name = self._options.topics[role]
        for topic in fitting:
            if topic.name == name:
                return topic
        there = ", ".join(map(str, fitting[:LISTED])) or "none"
        raise ImportSourceError(f"{self._bag.src}: no topic '{name}' of images for {role}; there are {there}")

    def _only(self, role: str, fitting: list[_Topic]) -> _Topic:
        if len(fitting) == 1:
            return fitting[0]
        if not fitting:
            raise ImportSourceError(f"{self._bag.src}: no topic has images; there are {self._bag.listing()}")
        raise ImportSourceError(
            f"{self._bag.src}: several topics fit the {role}: {', '.join(map(str, fitting[:LISTED]))}; name one: "
            f"--topic {role}={fitting[0].name}"
        )

    def _has_info(self, topic: _Topic) -> bool:
        return any(name in self._bag.topics(_INFO) for name in _info_names(topic))

    def _info_topic(self, topic: _Topic, wanted: str) -> str:
        infos = self._bag.topics(_INFO)
        names = [wanted] if wanted else _info_names(topic)
        name = names[0]
        for known in names:
            if known in infos:
                return known
        if not wanted and len(infos) == 1:
            self.notices.append(f"the calibration of {topic.name} is that of {infos[0]}, the only one")
            return infos[0]
        others = f"there are {', '.join(infos[:LISTED])}: name one with --topic info=NAME"
        raise ImportSourceError(
            f"{self._bag.src}: no camera_info at {name}, without which the focal length of {topic.name} is not known; "
            f"{others if infos else 'the bag has no such topic'}"
        )

    def _with_frame(self, topic: _Topic, info: str) -> _Topic:
        """The topic with the frame of its calibration, where its images name none."""
        whose = "a later image"
        if not topic.frame and info:
            messages = (message for _, _, message, _ in islice(self._bag.messages({info}), LOOKED_AT))
            frame = next(filter(None, (frame_name(message.header.frame_id) for message in messages)), "")
            topic, whose = replace(topic, frame=frame, frame_late=bool(frame)), info
        if topic.frame_late:
            self.notices.append(f"{topic.name}: its first image names no frame; '{topic.frame}' of {whose} is taken")
        return topic

    def _pose_topic(self) -> str:
        """The topic that poses come from; empty = tf.

        Raises:
            ImportSourceError: the named one is not there, or several fit.
        """
        found = self._bag.topics(*_NAMED_POSES, *_POSES)
        name = self._options.topics.get("pose", "")
        if name and name not in found:
            there = ", ".join(found[:LISTED]) or "none"
            raise ImportSourceError(f"{self._bag.src}: no topic '{name}' of poses; there are {there}")
        in_world = set(WORLD_FRAMES) & set(self._tree.way_up(self._color_topic.frame))
        if name or self._options.world or in_world:
            return name
        if len(found) > 1:
            raise ImportSourceError(
                f"{self._bag.src}: several topics tell poses: {', '.join(found[:LISTED])}; name one: "
                f"--topic pose={found[0]}"
            )
        return found[0] if found else ""

    def _refuse_no_poses(self, color: _Topic) -> None:
        """Raises: ImportSourceError: nothing in the bag tells poses."""
        if not self._bag.topics(*_NAMED_POSES, *_POSES, *_TF):
            raise ImportSourceError(
                f"{self._bag.src}: has no poses: neither tf nor a topic of "
                f"{', '.join(t.replace('/msg/', '/') for t in (*_NAMED_POSES, *_POSES))}; it has {self._bag.listing()}"
                + self._path_hint()
                + (_VIEWER if color.name.startswith(_REALSENSE_VIEWER) else "")
            )

    def _path_hint(self) -> str:
        paths = self._bag.topics("nav_msgs/msg/Path")
        return f" ({paths[0]}, a nav_msgs/Path, is not read)" if paths else ""

    def _read_all(self, infos: set[str]) -> tuple[dict[str, list[Any]], dict[str, list[tuple[int, Any]]]]:
        """One pass over the bag: stamps of images and transforms; returns calibrations and timed poses by topic."""
        calibrations: dict[str, list[Any]] = {name: [] for name in infos}
        self._info_stamps: dict[str, list[int]] = {name: [] for name in infos}
        poses: dict[str, list[tuple[int, Any]]] = {name: [] for name in self._bag.topics(*_NAMED_POSES, *_POSES)}
        transforms = self._bag.topics(*_TF)
        stamps: dict[str, list[int]] = {name: [] for name in self._stamps}
        received: dict[str, list[int]] = {name: [] for name in self._stamps}
        for name, received_ns, message, node in self._bag.messages({*self._stamps, *infos, *transforms, *poses}):
            if name in self._stamps:
                if len(message.data):
                    self._first_image.setdefault(name, message)
                stamps[name].append(stamp_of(message.header))
                received[name].append(received_ns)
            elif name in calibrations:
                calibrations[name].append(message)
                self._info_stamps[name].append(stamp_of(message.header) or received_ns)
            elif name in transforms:
                self._tree.add(message.transforms, name, node, received_ns)
            else:
                poses[name].append((received_ns, message))
        self.notices += self._tree.close(self._color_topic.name)
        unstamped = sum(fill_stamps(stamps[name], received[name]) for name in stamps)
        self._stamps = {name: list(zip(stamps[name], received[name], strict=True)) for name in stamps}
        if unstamped:
            self.notices.append(f"{unstamped} images have no stamp: the time at which they were recorded stands for it")
        return calibrations, poses

    def _intrinsics(self, topic: _Topic, infos: list[Any], name: str) -> list[tuple[int, CameraIntrinsics]]:
        """Intrinsics by time, all of one lens.

        Raises:
            ImportSourceError: they change, or cannot be used.
        """
        if not infos:
            raise ImportSourceError(f"{self._bag.src}: {name} has no message")
        timed = list(zip(self._info_stamps[name], infos, strict=True))
        good = [(stamp_ns, info) for stamp_ns, info in timed if self._bag.is_calibrated(info)]
        if good and len(good) < len(infos):
            self.notices.append(
                f"{name}: {counted(len(infos) - len(good), 'message')} without a calibration passed over"
            )
        try:
            size = self._size(topic, infos)
            lenses = [
                (stamp_ns, self._bag.intrinsics(info, size, rectified=topic.rectified))
                for stamp_ns, info in good or timed[:1]
            ]
        except ImportSourceError as error:
            raise ImportSourceError(f"{self._bag.src}: {topic.name}: {error}") from error
        found = [k for _, k in lenses]
        if any(k.distortion != found[0].distortion or not _one_lens(found[0], k) for k in found):
            raise ImportSourceError(
                f"{self._bag.src}: the calibration of {topic.name} changes ({found[0]}, then {found[-1]}): the lens "
                "has zoomed or the size was switched; cut the bag where it does"
            )
        return lenses

    def _size(self, topic: _Topic, infos: list[Any]) -> tuple[int, int] | None:
        """(width, height) of the first image, where a calibration does not tell it."""
        image = self._first_image.get(topic.name)
        if image is None or all(info.width and info.height for info in infos):
            return None
        self.notices.append(f"the camera_info of {topic.name} tells no size; that of its first image is taken")
        if topic.raw:
            return image.width, image.height
        try:
            rgb, _ = ros_images.compressed_color_image(image)
        except CodecError:  # reported when its turn comes
            return None
        return rgb.shape[1], rgb.shape[0]

    def _link_depth(self, depth: _Topic, own: CameraIntrinsics | None) -> None:
        """How depth comes to the pixels of colour.

        Raises:
            ImportSourceError: it is of another camera, and nobody says where that one sits.
        """
        color = self._color_topic
        own = own if own is None or own.distorted or not self._is_scaled(own) else self._measured
        linked = depth.frame != color.frame and self._tree.reaches(color.frame, depth.frame)
        if linked:
            self._check_sources(color.frame, depth.frame)
        T = self._tree.lookup(color.frame, depth.frame, self._color[0][0], MAX_STAMP_NS) if linked else np.eye(4)
        if own is None:
            self.notices.append(f"{depth.name} has no calibration: it is taken as registered to {color.name}")
            return
        if own == self._measured and (T is None or np.allclose(T, np.eye(4), atol=_SAME_PLACE)):
            return
        if own.distorted:
            raise ImportSourceError(
                f"{self._bag.src}: {depth.name} has lens distortion of its own; record depth that is registered to "
                "colour, or import without it: --topic depth=none"
            )
        if T is None or (depth.frame != color.frame and not linked):
            raise ImportSourceError(
                f"{self._bag.src}: {depth.name} is of another camera ({depth.frame}) than {color.name} ({color.frame})"
                ", and tf does not link the two; record tf_static or registered depth, or import without it: "
                "--topic depth=none"
            )
        self._T_color_depth, self._depth_intrinsics = invert_pose(self._T_frame_image) @ T, own
        self.notices.append(f"{depth.name} is registered to {color.name} here, by tf and the intrinsics of both")

    def _pose_source(self, topic: str, messages: list[tuple[int, Any]]) -> tuple[Callable[[int], Float64 | None], str]:
        """What tells the pose of a time, and a sentence on it.

        Raises:
            ImportSourceError: nothing does.
        """
        within_ns = round(self._options.match_s * 1e9)
        camera, tree = self._color_topic.frame, self._tree
        if not topic:
            world = self._world(camera)
            self._check_sources(world, camera)
            self._moving = tree.moving_above(camera, world)

            def from_tf(stamp_ns: int) -> Float64 | None:
                T_world_camera = tree.lookup(world, camera, stamp_ns, within_ns)
                return None if T_world_camera is None else T_world_camera @ self._T_frame_image

            return from_tf, f"poses are those of {camera} in {world}, from tf"
        body, track = self._track(topic, messages)
        if body != camera and not tree.reaches(body, camera):
            raise ImportSourceError(
                f"{self._bag.src}: {topic} tells where '{body}' is, but tf does not say where the camera '{camera}' "
                f"sits on it; record tf_static, or say with --body {camera} that the poses are the camera's"
            )
        self._check_sources(body, camera)
        if jump := track.jump_m():
            raise ImportSourceError(
                f"{self._bag.src}: the poses of {topic} jump to and fro by {jump:.2g} m or rad: two programs publish "
                "it; record one of them, or name another topic: --topic pose=NAME"
            )
        self._moving = [(topic, track)]
        self.notices += track.oddities(topic)

        def pose_at(stamp_ns: int) -> Float64 | None:
            T_world_body = track.at(stamp_ns, within_ns)
            T_body_camera = tree.lookup(body, camera, stamp_ns, within_ns)
            if T_world_body is None or T_body_camera is None:
                return None
            return T_world_body @ T_body_camera @ self._T_frame_image

        return pose_at, f"poses are those of {camera}, from {topic} of {body}"

    def _check_sources(self, target: str, source: str) -> None:
        """Raises: ImportSourceError: tf has two truths about a transform between the frames."""
        try:
            self._tree.check(target, source)
        except ImportSourceError as error:
            raise ImportSourceError(f"{self._bag.src}: {error}") from error

    def _image_pose(self, color: _Topic, infos: list[Any]) -> Float64:
        """``T_frame_image`` (4, 4): how a stereo camera's rectification has turned the image within its frame."""
        T = np.eye(4)
        info = next((info for info in infos if self._bag.is_calibrated(info)), None)
        if not color.rectified or info is None:
            return T
        R, P = self._bag.rectification(info)
        if R.any() and not np.allclose(R, np.eye(3), atol=1e-6):
            T[:3, :3] = R.T
            self.notices.append(
                f"{color.name}: rectification has turned the image (R of its camera_info); poses turn with it"
            )
        if P[3]:
            self.notices.append(
                f"{color.name}: is the right image of a stereo camera (P of its camera_info); '{color.frame}' is taken "
                "as the frame of this camera, not of the left one"
            )
        return T

    def _refuse_contradictions(self, color: _Topic, name: str, calibrations: Mapping[str, list[Any]]) -> None:
        """Raises: ImportSourceError: another topic gives the same camera frame another calibration."""
        own = next((info for info in calibrations[name] if self._bag.is_calibrated(info)), None)
        for other, infos in calibrations.items():
            info = next((info for info in infos if self._bag.is_calibrated(info)), None)
            if own is None or info is None or frame_name(info.header.frame_id) != frame_name(own.header.frame_id):
                continue
            try:
                a, b = (self._bag.intrinsics(i, None, rectified=False) for i in (own, info))
            except ImportSourceError:  # of a lens that is not undone: another camera's
                continue
            comparable = "depth" not in other.lower() and same_view((a.width, a.height), (b.width, b.height))
            bent_otherwise = a.distorted and b.distorted and a.distortion != b.distortion
            if comparable and (bent_otherwise or not _one_lens(a, b)):
                raise ImportSourceError(
                    f"{self._bag.src}: {name} and {other} give the camera frame '{color.frame}' two calibrations ({a}, "
                    f"{b}); name the true one: --topic info={name} or --topic info={other}"
                )

    def _refuse_two_lenses(self, depth: _Topic, own: CameraIntrinsics, name: str, depth_name: str) -> None:
        """Raises: ImportSourceError: depth has the frame of colour, and another lens."""
        if depth.frame == self._color_topic.frame and not own.distorted and not _one_lens(self._measured, own):
            raise ImportSourceError(
                f"{self._bag.src}: {depth.name} has the frame of {self._color_topic.name}, '{depth.frame}', but its "
                f"calibration has other intrinsics ({own}, colour {self._measured}). Where depth is registered to "
                f"colour: --topic depth_info={name}; where it has a lens of its own: --topic depth_info={depth_name}; "
                "without it: --topic depth=none"
            )

    def _is_scaled(self, own: CameraIntrinsics) -> bool:
        """Whether depth is colour's view at its size, for rounding of the calibration."""
        k = self._measured
        same = (own.width, own.height, own.distortion) == (k.width, k.height, k.distortion)
        return same and _one_lens(k, own) and self._topics_share_frame()

    def _topics_share_frame(self) -> bool:
        return self._depth_topic is not None and self._depth_topic.frame == self._color_topic.frame

    def _check_times(self, topic: str) -> None:
        """Raises: ImportSourceError: no image was taken while poses were."""
        stamps = np.array([stamp for stamp, _ in self._color], np.int64)
        margin = round(self._options.match_s * 1e9)
        for name, track in self._moving:
            if len(stamps) and len(track.stamps_ns):
                first, last = int(track.stamps_ns[0]) - margin, int(track.stamps_ns[-1]) + margin
                if stamps.max() < first or stamps.min() > last:
                    what = f"poses of {topic}" if topic else f"transforms of tf from {name}"
                    raise ImportSourceError(
                        f"{self._bag.src}: images of {self._color_topic.name} are from {_span(stamps)}, {what} from "
                        f"{_span(track.stamps_ns)}: their clocks differ; record both with one clock (use_sim_time)"
                    )

    def _gap(self, stamp_ns: int) -> str:
        """Which transform is missing at a time."""
        within_ns = round(self._options.match_s * 1e9)
        for name, track in self._moving:
            if track.at(stamp_ns, within_ns) is None:
                return f"; {name} is there from {_span(track.stamps_ns)}, and not near it"
        return ""

    def _track(self, topic: str, messages: list[tuple[int, Any]]) -> tuple[str, Track]:
        """Whose poses a topic tells, and the poses."""
        named = topic in self._bag.topics(*_NAMED_POSES)
        body = frame_name(self._options.body or (messages[0][1].child_frame_id if named and messages else ""))
        if messages and not body:
            raise ImportSourceError(
                f"{self._bag.src}: {topic} does not say whose poses it tells; name the frame with --body, such as "
                f"--body {self._color_topic.frame} where they are the camera's"
            )
        read = self._bag.pose_reader(topic)
        stamps = [stamp_of(message.header) for _, message in messages]
        unstamped = fill_stamps(stamps, [received_ns for received_ns, _ in messages])
        rows = [(stamp, pose_row(*read(message))) for stamp, (_, message) in zip(stamps, messages, strict=True)]
        if unstamped:
            self.notices.append(
                f"{topic}: {counted(unstamped, 'pose')} without a stamp; the time of receipt stands for it"
            )
        good = [(stamp, row) for stamp, row in rows if row is not None]
        if not good:
            raise ImportSourceError(f"{self._bag.src}: {topic} holds no pose")
        if len(good) < len(rows):
            self.notices.append(f"{len(rows) - len(good)} poses of {topic} are left out: they hold NaN or no rotation")
        return body, Track([stamp for stamp, _ in good], [row for _, row in good])

    def _world(self, camera: str) -> str:
        """The frame of tf in which poses are."""
        way = self._tree.way_up(camera)
        wanted = frame_name(self._options.world)
        if wanted:
            if wanted in way:
                return wanted
            raise ImportSourceError(f"{self._bag.src}: tf has no way from {camera} to {wanted}: {_on(way)}")
        for world in WORLD_FRAMES:
            if world in way:
                return world
        if len(way) == 1:
            raise ImportSourceError(
                f"{self._bag.src}: tf does not know the frame '{camera}' of {self._color_topic.name}; record tf and "
                "tf_static, or name a topic of poses: --topic pose=NAME --body " + (camera or "FRAME")
            )
        if not self._tree.moving_above(camera, way[-1]):
            raise ImportSourceError(
                f"{self._bag.src}: tf has no frame {', '.join(WORLD_FRAMES)} above the camera: {_on(way)}; and nothing "
                f"tells how '{way[-1]}' moves: record tf or odometry{self._path_hint()}. Only where the camera stood "
                f"still: --world {way[-1]}"
            )
        raise ImportSourceError(
            f"{self._bag.src}: tf has no frame {', '.join(WORLD_FRAMES)} above the camera: {_on(way)}; name the world: "
            f"--world {way[-1]}, or a topic of poses: --topic pose=NAME"
        )


def register_depth(depth_m: Float32, own: CameraIntrinsics, T_color_depth: Float64, color: CameraIntrinsics) -> Float32:
    """Depth of one camera in the pixels of another: (H, W) of ``color``, the nearest surface, 0 where none falls.

    Args:
        depth_m: (h, w) in metres, 0 = no measurement.
        own: Intrinsics of the depth camera, without distortion.
        T_color_depth: (4, 4) from the depth camera to the colour camera.
        color: Intrinsics of the colour camera, without distortion.
    """
    points = transform(T_color_depth, unproject(depth_m, own).reshape(-1, 3)[depth_m.ravel() > 0])
    points = points[points[:, 2] > 0]
    u = np.rint(color.fx * points[:, 0] / points[:, 2] + color.cx)
    v = np.rint(color.fy * points[:, 1] / points[:, 2] + color.cy)
    inside = (u >= 0) & (u < color.width) & (v >= 0) & (v < color.height)
    pixels = v[inside].astype(np.int64) * color.width + u[inside].astype(np.int64)
    nearest = np.full(color.height * color.width, np.inf, np.float32)
    np.minimum.at(nearest, pixels, points[inside, 2].astype(np.float32))
    nearest[np.isinf(nearest)] = 0
    return nearest.reshape(color.height, color.width)


class _Bag:
    """A bag that is open, by the names of its topics.

    Raises:
        ImportSourceError: it cannot be read.
        DependencyError: the package is missing.
    """

    def __init__(self, src: Path) -> None:
        self.src = src
        highlevel, typesys = _load_rosbags()
        paths, self._unpacked = readable_bag(src)  # what was made for it is there as long as this is
        with self._explained():
            # Bags of ROS 2 before Iron hold no definitions of their messages; those read here have not changed since.
            self._reader = highlevel.AnyReader(
                paths, default_typestore=typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
            )
            self._reader.open()
        self._is_ros2: bool = self._reader.is2
        self._streams: dict[str, tuple[int, Iterator[tuple[Any, int, bytes]]]] = {}  # next index, and its messages

    def topics(self, *types: str) -> list[str]:
        """Names of topics of these types that have messages."""
        return sorted({c.topic for c in self._reader.connections if c.msgtype in types and c.msgcount})

    def listing(self) -> str:
        """All topics, for people."""
        names = sorted({f"{c.topic} ({c.msgtype.replace('/msg/', '/')})" for c in self._reader.connections})
        more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
        return visible(", ".join(names[:LISTED])) + more if names else "no topic at all"

    def image_topics(self) -> list[_Topic]:
        """Topics of images that have messages, by the first of them that tell what they are."""
        found: list[_Topic] = []
        for kind, field in ((_RAW, "encoding"), (_COMPRESSED, "format")):
            for name in self.topics(kind):
                encodings: list[str] = []
                frames: list[str] = []
                for _, _, message, _ in islice(self.messages({name}), LOOKED_AT):
                    encodings.append(str(getattr(message, field)) if len(message.data) else "")
                    frames.append(frame_name(message.header.frame_id))
                    if encodings[-1] and any(frames):
                        break
                if frames:
                    # The RealSense Viewer gives all cameras one frame, "0", although they stand apart.
                    viewer = name.startswith(_REALSENSE_VIEWER)
                    frame = name.rsplit("/", 2)[0] if viewer else next(filter(None, frames), "")
                    encoding = next(filter(None, encodings), "")
                    found.append(_Topic(name, kind == _RAW, encoding, frame, frame_late=bool(frame) and not frames[0]))
        return found

    def messages(self, names: set[str]) -> Iterator[tuple[str, int, Any, str]]:
        """Topic, time of recording, message, and its node (ROS 1; else empty), in the order of recording."""
        with self._explained():
            for connection, received_ns, data in self._reader.messages(connections=self._connections(names)):
                node = "" if self._is_ros2 else connection.ext.callerid or ""
                yield connection.topic, received_ns, self._reader.deserialize(data, connection.msgtype), node

    def message(self, name: str, series: list[tuple[int, int]], index: int) -> Any:
        """One message of a topic; quick where they are read in order.

        Args:
            name: Of the topic.
            series: Stamp and time of recording of all its messages, in the order of recording.
            index: In ``series``.

        Raises:
            CodecError: it cannot be read.
        """
        position, stream = self._streams.get(name, (-1, iter(())))
        try:
            if not 0 <= position <= index:
                received_ns = series[index][1]
                position = next(i for i, (_, at_ns) in enumerate(series) if at_ns >= received_ns)
                stream = iter(self._reader.messages(connections=self._connections({name}), start=received_ns))
            with self._explained():
                connection, _, data = next(stream)
                while position < index:
                    connection, _, data = next(stream)
                    position += 1
                self._streams[name] = (position + 1, stream)
                return self._reader.deserialize(data, connection.msgtype)
        except (ImportSourceError, StopIteration) as error:
            self._streams.pop(name, None)
            raise CodecError(f"cannot be read: {error}") from error

    def intrinsics(self, info: Any, size: tuple[int, int] | None, *, rectified: bool) -> CameraIntrinsics:
        """See ``ros_images.intrinsics``."""
        K, D, P = self._matrices(info)
        rectified = rectified and bool(np.any(P) or np.any(D))  # a pinhole camera's driver may leave P empty
        size = (info.width, info.height) if (info.width and info.height) or size is None else size
        return ros_images.intrinsics(info, P if rectified else K, D, size, rectified=rectified)

    def depth_units(self, depth: str) -> float | None:
        """Units per metre of depth that the RealSense Viewer has recorded; None of other bags."""
        name = f"{depth.rsplit('/', 3)[0]}/option/Depth_Units/value"
        if not depth.startswith(_REALSENSE_VIEWER) or name not in self.topics("std_msgs/msg/Float32"):
            return None
        metres = float(next(self.messages({name}))[2].data)
        return 1 / metres if metres > 0 else None

    def is_calibrated(self, info: Any) -> bool:
        """Whether a ``sensor_msgs/CameraInfo`` says anything: cameras send some before they know."""
        K, D, P = self._matrices(info)
        return bool((np.any(K) or np.any(P)) and all(np.isfinite(matrix).all() for matrix in (K, D, P)))

    def rectification(self, info: Any) -> tuple[Float64, Float64]:
        """R (3, 3) and P (12,) of a ``sensor_msgs/CameraInfo``."""
        R = info.r if self._is_ros2 else info.R
        return np.asarray(R, np.float64).reshape(3, 3), self._matrices(info)[2]

    def _matrices(self, info: Any) -> tuple[Float64, Float64, Float64]:
        return (info.k, info.d, info.p) if self._is_ros2 else (info.K, info.D, info.P)

    def pose_reader(self, topic: str) -> Callable[[Any], tuple[Any, Any]]:
        """What takes position and rotation out of a message of a topic of poses."""
        kinds: Mapping[str, Callable[[Any], tuple[Any, Any]]] = {
            "nav_msgs/msg/Odometry": lambda m: (m.pose.pose.position, m.pose.pose.orientation),
            "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: (m.pose.pose.position, m.pose.pose.orientation),
            "geometry_msgs/msg/PoseStamped": lambda m: (m.pose.position, m.pose.orientation),
            "geometry_msgs/msg/TransformStamped": lambda m: (m.transform.translation, m.transform.rotation),
        }
        return kinds[self._connections({topic})[0].msgtype]

    def _connections(self, names: set[str]) -> list[Any]:
        return [c for c in self._reader.connections if c.topic in names]

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Make of whatever a damaged bag leads to an error that says what to do."""
        try:
            yield
        except (SemanticMapperError, StopIteration, MemoryError):
            raise
        except Exception as error:  # storage, compression and messages each raise their own
            raise ImportSourceError(
                f"{self.src}: this ROS bag cannot be read: {visible(str(error)) or type(error).__name__}; {_REPAIR}"
            ) from error


def _load_rosbags() -> tuple[Any, Any]:
    try:
        return importlib.import_module("rosbags.highlevel"), importlib.import_module("rosbags.typesys")
    except ImportError as error:
        raise DependencyError(
            f"ROS bags cannot be read: {error}. Run `make setup`, or install it yourself: pip install 'rosbags>=0.11.9'"
        ) from error


def _without_doubles(topics: list[_Topic]) -> list[_Topic]:
    """Of each camera one transport: raw images where there are some."""
    by_base = {t.base: t for t in sorted(topics, key=lambda t: t.raw)}
    return [t for t in topics if t in by_base.values()]


def _info_names(topic: _Topic) -> list[str]:
    """Where the calibration of images is; the second place is that of the RealSense Viewer."""
    return [f"{topic.base.rsplit('/', 1)[0]}/camera_info", f"{topic.base.rsplit('/', 2)[0]}/info/camera_info"]


def _span(stamps_ns: NDArray[np.int64]) -> str:
    return f"{stamps_ns.min() / 1e9:.3f} to {stamps_ns.max() / 1e9:.3f} s"


def _one_lens(a: CameraIntrinsics, b: CameraIntrinsics) -> bool:
    """Whether two calibrations are of one lens, at any size of its image."""
    if not same_view((a.width, a.height), (b.width, b.height)):
        return False
    b = scale_intrinsics(b, a.width, a.height)
    focal = max(abs(a.fx - b.fx) / a.fx, abs(a.fy - b.fy) / a.fy)
    return focal < _SAME_LENS and max(abs(a.cx - b.cx), abs(a.cy - b.cy)) < _SAME_LENS * a.width


def _on(way: list[str]) -> str:
    return " on ".join(f"'{frame}'" for frame in way)


def _distinct(lenses: list[tuple[int, CameraIntrinsics]]) -> tuple[NDArray[np.int64], list[CameraIntrinsics]]:
    """Stamps in their order, and the intrinsics of each; those that do not differ much are one."""
    known = lenses[0][1]
    found: list[CameraIntrinsics] = []
    ordered = sorted(lenses, key=lambda lens: lens[0])
    for _, k in ordered:
        focal = max(abs(known.fx - k.fx) / known.fx, abs(known.fy - k.fy) / known.fy)
        if focal > _FOCAL_CHANGE or max(abs(known.cx - k.cx), abs(known.cy - k.cy)) > _CENTRE_CHANGE:
            known = k
        found.append(known)
    return np.array([stamp_ns for stamp_ns, _ in ordered], np.int64), found


def _rate(stamps: Any) -> float:
    """Images a second, 0 where it is unknown."""
    if len(stamps) < 2 or stamps.max() == stamps.min():
        return 0.0
    return round(1e9 * (len(stamps) - 1) / float(stamps.max() - stamps.min()), 3)
