"""ROS bags of version 1 (``.bag``) and 2 (folder, ``.mcap`` or ``.db3``), read without ROS.

A frame is a colour image with the depth image nearest in time and its pose. Poses come from tf, from the world (map,
world or odom) to the frame that the image names, interpolated between the neighbours of each transform; or from a
topic of odometry or poses, whose body tf then links to the camera. Topics are found by the type of their messages.

Depth that is not registered to colour is registered here, by the two cameras' intrinsics and tf. Lens distortion is
removed where the camera's calibration tells of it and its images are not rectified already.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.drivers.calibration import Rectifier
from semantic_mapper.errors import CodecError, ImportSourceError
from semantic_mapper.geometry import invert_pose, scale_intrinsics, transform, unproject
from semantic_mapper.replay.importers import ros_bags, ros_transforms
from semantic_mapper.replay.importers.base import (
    MATCH_NS,
    BadFrameError,
    DepthScale,
    ImportOptions,
    depth_of_points,
    same_view,
)
from semantic_mapper.replay.importers.posed import PosedPicture, PosedPictures, depth_of_size
from semantic_mapper.replay.importers.tum import match_nearest
from semantic_mapper.transport.codec import EncodedImage
from semantic_mapper.types import MAX_STAMP_NS, CameraIntrinsics, Float32, Float64, UInt8

DecodedT = TypeVar("DecodedT")

ROLES = ("image", "depth", "info", "depth_info", "pose")
DEPTH_SCALE = DepthScale(ros_bags.UNITS_PER_M, convention="ROS's millimetres (16UC1) or metres (32FC1)")

_SAME_PLACE = 1e-6  # of a transform's entries; cameras that are closer are one
_SAME_LENS = 0.005  # fraction of focal length and width that two calibrations of one lens differ by at most
_REALSENSE_VIEWER = "/device_"  # begins the topics of its recordings
_VIEWER = (
    ". Recordings of the RealSense Viewer have none: record with ROS and an odometry, or live with `semantic-mapper "
    "up` of a launch file with a camera of kind realsense, which finds poses"
)


def open_rosbag(src: Path, options: ImportOptions) -> PosedPictures:
    """A bag, ``.bag``, ``.mcap``, ``.db3`` or folder of ROS 2, opened; one frame for each image of one camera.

    Raises ImportSourceError: damaged, no image, several cameras where none is named, no calibration, or no poses.
    """
    try:
        return _BagReader(src, options).pictures()
    except ImportSourceError as error:
        raise ImportSourceError(f"{src}: {error}") from error


class _BagReader:
    def __init__(self, src: Path, options: ImportOptions) -> None:
        self.notices: list[str] = []
        self._src, self._options = src, options
        unknown = sorted(set(options.topics) - set(ROLES))
        if unknown:
            raise ImportSourceError(f"no topic has the role '{unknown[0]}'; the roles are {', '.join(ROLES)}")
        self._bag = ros_bags.Bag(src)
        self._color, self._depth = self._find_images()
        if not self._bag.topics(*ros_bags.POSES, *ros_bags.TF):
            kinds = ", ".join(t.replace("/msg/", "/") for t in ros_bags.POSES)
            hint = _VIEWER if self._color.name.startswith(_REALSENSE_VIEWER) else ""
            raise ImportSourceError(
                f"has no poses: neither tf nor a topic of {kinds}; it has {self._bag.listing()}{hint}"
            )
        info, depth_info = self._info_topic(self._color, "info"), ""
        if self._depth is not None:
            own = "depth_info" in options.topics or _info_name(self._depth) in self._bag.topics(ros_bags.CAMERA_INFO)
            depth_info = self._info_topic(self._depth, "depth_info") if own else ""
        self._read_all()
        self._frame = self._color.frame or self._calibrations[info][0].frame
        self._measured = self._intrinsics(self._color, info)
        self._T_frame_image = self._image_pose(info)
        if "info" not in options.topics:
            self._refuse_contradictions(info)
        self._registration: tuple[CameraIntrinsics, Float64] | None = None  # of depth, and T_color_depth; None = it is
        if self._depth is not None:
            self._registration = self._link_depth(self._depth, depth_info)
        self._pose_at = self._pose_source()

    def pictures(self) -> PosedPictures:
        """The images with poses and depth; each is named by its topic and its number in the bag."""
        stamps = self._stamps[self._color.name]
        depth_stamps = np.zeros(0, np.int64) if self._depth is None else self._stamps[self._depth.name]
        order, depth_order = (np.argsort(found, kind="stable") for found in (stamps, depth_stamps))
        matches = match_nearest(stamps[order], depth_stamps[depth_order], MATCH_NS)
        pictures: list[PosedPicture] = []
        for index, match in zip(order.tolist(), matches, strict=True):
            file, stamp_ns = Path(self._color.name) / str(index), int(stamps[index])
            pose = self._pose_at(stamp_ns) if 0 <= stamp_ns < MAX_STAMP_NS else None
            if pose is None:
                pose = BadFrameError(file, f"there is no pose round its time {stamp_ns / 1e9:.6f} s")
            depth = None
            if self._depth is not None and match >= 0:
                depth = Path(self._depth.name) / str(depth_order[match])
            pictures.append(PosedPicture(file, self._measured, pose, stamp_ns, depth))
        return PosedPictures(
            f"rosbag {self._src.resolve().stem}",
            pictures,
            self._options,
            DEPTH_SCALE,
            self.notices,
            hz=round(1e9 * (len(stamps) - 1) / span_ns, 3) if (span_ns := int(np.ptp(stamps))) else 0.0,
            read_rgb=self._rgb,
            read_depth=self._depth_m,
        )

    def _decoded(self, topic: ros_bags.Topic, file: Path, decode: Callable[[Any], DecodedT]) -> DecodedT:
        try:
            return decode(self._bag.message(topic.name, self._received[topic.name], int(file.name)))
        except CodecError as error:
            raise BadFrameError(file, str(error)) from error

    def _rgb(self, file: Path) -> tuple[UInt8, EncodedImage | None]:
        return self._decoded(self._color, file, ros_bags.color_image if self._color.raw else ros_bags.compressed_image)

    def _depth_m(self, picture: PosedPicture, lens: Rectifier) -> Float32:
        assert self._depth is not None and picture.depth_file is not None
        decode = ros_bags.depth_image if self._depth.raw else ros_bags.compressed_depth_image
        depth_m = self._decoded(self._depth, picture.depth_file, decode)
        if self._registration is None:
            size = (lens.intrinsics.height, lens.intrinsics.width)
            return lens.nearest(depth_of_size(depth_m, size, picture.depth_file))
        own, T_color_depth = self._registration
        if depth_m.shape != (own.height, own.width):
            raise BadFrameError(
                picture.depth_file,
                f"the depth image is {depth_m.shape[1]}x{depth_m.shape[0]}, its calibration says "
                f"{own.width}x{own.height}; name the one that it has (--topic depth_info=NAME), or import without "
                "depth (--topic depth=none)",
            )
        points = transform(T_color_depth, unproject(depth_m, own)[depth_m > 0])
        return depth_of_points(points, lens.intrinsics)

    def _find_images(self) -> tuple[ros_bags.Topic, ros_bags.Topic | None]:
        topics, wanted = self._bag.image_topics(), self._options.topics
        depths = [t for t in topics if t.is_depth]
        colors = [t for t in topics if t not in depths]
        fitting = _without_doubles(colors)
        color = self._choose("image", colors, [t for t in fitting if not t.is_grey] or fitting)
        left = [str(t) for t in fitting if t != color]
        if "image" not in wanted and left:
            self.notices.append(
                f"images are those of {color.name}; there are also {', '.join(left[: ros_bags.LISTED])}"
            )
        if self._options.without_depth:
            return color, None
        fitting = _without_doubles(depths)
        if not fitting and "depth" not in wanted:
            self.notices.append("no topic has depth images: frames come without depth")
            return color, None
        return color, self._choose("depth", depths, [t for t in fitting if t.frame == color.frame] or fitting)

    def _choose(self, role: str, topics: list[ros_bags.Topic], fitting: list[ros_bags.Topic]) -> ros_bags.Topic:
        """The one of the topics that is named, or else the only one that fits."""
        name = self._named(role, [topic.name for topic in topics])
        found = [topic for topic in topics if topic.name == name] or fitting
        if not found:
            raise ImportSourceError(f"no topic has images; there are {self._bag.listing()}")
        if not name and len(found) > 1:
            raise _several(role, [str(topic) for topic in found], found[0].name)
        return found[0]

    def _named(self, role: str, names: list[str]) -> str:
        """The topic that the user names for a role, out of these; empty = none is named."""
        name = self._options.topics.get(role, "")
        if name and name not in names:
            raise ImportSourceError(
                f"no topic '{name}' fits the {role}; there are {', '.join(names[: ros_bags.LISTED]) or 'none'}"
            )
        return name

    def _info_topic(self, topic: ros_bags.Topic, role: str) -> str:
        infos = self._bag.topics(ros_bags.CAMERA_INFO)
        name = self._named(role, infos) or _info_name(topic)
        if name in infos:
            return name
        if len(infos) == 1:
            self.notices.append(f"the calibration of {topic.name} is that of {infos[0]}, the only one")
            return infos[0]
        others = f"there are {', '.join(infos[: ros_bags.LISTED])}: name one with --topic info=NAME"
        raise ImportSourceError(
            f"no camera_info at {name}, without which the focal length of {topic.name} is not known; "
            f"{others if infos else 'the bag has no such topic'}"
        )

    def _read_all(self) -> None:
        """One pass over the bag: times of images, calibrations, transforms and poses, by topic."""
        images = {topic.name for topic in (self._color, self._depth) if topic is not None}
        infos, poses, transforms = (
            set(self._bag.topics(*kinds)) for kinds in ((ros_bags.CAMERA_INFO,), ros_bags.POSES, ros_bags.TF)
        )
        stamps: dict[str, list[int]] = {name: [] for name in images}
        self._received: dict[str, list[int]] = {name: [] for name in images}
        self._calibrations: dict[str, list[ros_bags.Calibration]] = {name: [] for name in infos}
        self._poses = {name: ros_transforms.PoseSeries() for name in poses}
        self._bodies: dict[str, str] = {}  # of topics of poses that tell whose they are
        self._tree = ros_transforms.TransformTree()
        for name, received_ns, message, node in self._bag.messages(images | infos | poses | transforms):
            if name in images:
                stamps[name].append(ros_transforms.stamp_of(message.header))
                self._received[name].append(received_ns)
            elif name in infos:
                found, known = ros_bags.Calibration(message), self._calibrations[name]
                if found.says_something or not known:
                    known[:] = [*(old for old in known if old.says_something), found]
            elif name in transforms:
                for stamped in message.transforms:
                    self._tree.add(stamped, f"{name} of {node}" if node else name, received_ns)
            else:
                self._poses[name].add(message, received_ns)
                self._bodies.setdefault(name, getattr(message, "child_frame_id", ""))
        self.notices += self._tree.close()
        for name in images:
            self.notices += ros_transforms.fill_stamps(stamps[name], self._received[name], name)
        self._stamps = {name: np.array(values, np.int64) for name, values in stamps.items()}

    def _intrinsics(self, topic: ros_bags.Topic, info: str) -> CameraIntrinsics:
        unlike = {(c.model, c.size, *c.K, *c.D, *c.P): c for c in self._calibrations[info]}
        found = [c.intrinsics(f"camera_info of {topic.name}", rectified=topic.rectified) for c in unlike.values()]
        if any(k.distortion != found[0].distortion or not _one_lens(found[0], k) for k in found):
            raise ImportSourceError(
                f"the calibration of {topic.name} changes ({found[0]}, then {found[-1]}): the lens has zoomed or the "
                "size was switched; cut the bag where it does"
            )
        return found[0]

    def _image_pose(self, info: str) -> Float64:
        """``T_frame_image`` (4, 4): how a stereo camera's rectification has turned the image within its frame."""
        T, calibration = np.eye(4), self._calibrations[info][0]
        if not self._color.rectified:
            return T
        if calibration.R.any():
            T[:3, :3] = calibration.R.T
        if calibration.P[3]:
            self.notices.append(
                f"{self._color.name}: is the right image of a stereo camera (P of its camera_info); '{self._frame}' is "
                "taken as the frame of this camera, not of the left one"
            )
        return T

    def _refuse_contradictions(self, info: str) -> None:
        """Raises: ImportSourceError: another topic gives the same camera frame another calibration."""
        own = self._calibrations[info][0]
        for other, found in self._calibrations.items():
            if other == info or "depth" in other.lower() or found[0].frame != own.frame:
                continue
            try:
                a, b = (c.intrinsics(info, rectified=False) for c in (own, found[0]))
            except ImportSourceError:  # of a lens that is not undone: another camera's
                continue
            bent_otherwise = a.distorted and b.distorted and a.distortion != b.distortion
            if same_view((a.width, a.height), (b.width, b.height)) and (bent_otherwise or not _one_lens(a, b)):
                raise ImportSourceError(
                    f"{info} and {other} give the camera frame '{self._frame}' two calibrations ({a}, {b}); name the "
                    f"true one: --topic info={info} or --topic info={other}"
                )

    def _link_depth(self, depth: ros_bags.Topic, info: str) -> tuple[CameraIntrinsics, Float64] | None:
        """Intrinsics of depth and ``T_color_depth``, by which it is registered; None = it is registered already."""
        if not info:
            self.notices.append(f"{depth.name} has no calibration: it is taken as registered to {self._color.name}")
            return None
        color, own = self._measured, self._intrinsics(depth, info)
        frame = depth.frame or self._calibrations[info][0].frame
        one_lens = own.distortion == color.distortion and _one_lens(color, own)
        self._tree.check(self._frame, frame)
        first_ns = int(self._stamps[self._color.name][0])
        T_color_depth = self._tree.lookup(self._frame, frame, first_ns, MAX_STAMP_NS)
        if one_lens and T_color_depth is not None and np.allclose(T_color_depth, np.eye(4), atol=_SAME_PLACE):
            return None
        if own.distorted or T_color_depth is None:
            apart = f"is of another camera ({frame}) than {self._color.name} ({self._frame}), and tf does not link them"
            raise ImportSourceError(
                f"{depth.name} {'has lens distortion of its own' if own.distorted else apart}; record tf_static and "
                "depth that is registered to colour, or import without it: --topic depth=none"
            )
        if frame == self._frame and "depth_info" not in self._options.topics:
            raise ImportSourceError(
                f"{depth.name} has the frame of {self._color.name}, '{frame}', but its calibration has other "
                f"intrinsics ({own}, colour {color}). Where depth is registered to colour: --topic "
                f"depth_info={_info_name(self._color)}; where it has a lens of its own: --topic depth_info={info}; "
                "without it: --topic depth=none"
            )
        self.notices.append(f"{depth.name} is registered to {self._color.name} here, by tf and the intrinsics of both")
        return own, invert_pose(self._T_frame_image) @ T_color_depth

    def _pose_source(self) -> Callable[[int], Float64 | None]:
        """What tells the pose of a time: tf from the world to the camera, or a topic and tf from there on."""
        topic, frame, tree = self._pose_topic(), self._frame, self._tree
        base, track = self._track(topic) if topic else (self._world(), None)
        tree.check(base, frame)
        if track is None:
            moving = tree.moving_above(frame, base)
            self.notices.append(f"poses are those of {frame} in {base}, from tf")
        else:
            moving = [(topic, track)]
            self.notices.append(f"poses are those of {frame}, from {topic} of {base}")
        stamps_ns = self._stamps[self._color.name]
        for name, poses in moving:
            first, last = int(poses.stamps_ns[0]) - MATCH_NS, int(poses.stamps_ns[-1]) + MATCH_NS
            if stamps_ns.max() < first or stamps_ns.min() > last:
                raise ImportSourceError(
                    f"images of {self._color.name} are from {_span(stamps_ns)}, poses ({name}) from "
                    f"{_span(poses.stamps_ns)}: their clocks differ; record both with one clock (use_sim_time)"
                )

        def pose_at(stamp_ns: int) -> Float64 | None:
            T_world_base = np.eye(4) if track is None else track.at(stamp_ns)
            T_base_frame = tree.lookup(base, frame, stamp_ns)
            if T_world_base is None or T_base_frame is None:
                return None
            return T_world_base @ T_base_frame @ self._T_frame_image

        return pose_at

    def _pose_topic(self) -> str:
        """The topic that poses come from; empty = tf."""
        found = self._bag.topics(*ros_bags.POSES)
        name = self._named("pose", found)
        if name or self._options.world or set(ros_transforms.WORLD_FRAMES) & set(self._tree.way_up(self._frame)):
            return name
        if len(found) > 1:
            raise _several("pose", found, found[0])
        return found[0] if found else ""

    def _track(self, topic: str) -> tuple[str, ros_transforms.Track]:
        """Whose poses a topic tells, and the poses."""
        body, frame = ros_bags.frame_name(self._options.body or self._bodies[topic]), self._frame
        if not body:
            raise ImportSourceError(
                f"{topic} does not say whose poses it tells; name the frame with --body, such as --body {frame} "
                "where they are the camera's"
            )
        track = self._poses[topic].track(topic, self.notices)
        if track is None:
            raise ImportSourceError(f"{topic} holds no pose")
        if self._tree.way_up(body)[-1] != self._tree.way_up(frame)[-1]:
            raise ImportSourceError(
                f"{topic} tells where '{body}' is, but tf does not say where the camera '{frame}' sits on it; record "
                f"tf_static, or say with --body {frame} that the poses are the camera's"
            )
        if jump := track.jump_m():
            raise ImportSourceError(
                f"the poses of {topic} jump to and fro by {jump:.2g} m or rad: two programs publish it; record one of "
                "them, or name another topic: --topic pose=NAME"
            )
        return body, track

    def _world(self) -> str:
        """The frame of tf in which poses are."""
        way = self._tree.way_up(self._frame)
        wanted = ros_bags.frame_name(self._options.world)
        frames = (wanted,) if wanted else ros_transforms.WORLD_FRAMES
        world = next((world for world in frames if world in way), None)
        if world is not None:
            return world
        if len(way) == 1:
            raise ImportSourceError(
                f"tf does not know the frame '{self._frame}' of {self._color.name}; record tf and tf_static, or name a "
                f"topic of poses: --topic pose=NAME --body {self._frame or 'FRAME'}"
            )
        still = "" if self._tree.moving_above(self._frame, way[-1]) else ", where the camera stood still"
        raise ImportSourceError(
            f"tf has no frame {', '.join(frames)} above the camera: {' on '.join(map(repr, way))}; record tf or "
            f"odometry, or name a topic of poses (--topic pose=NAME), or the world{still}: --world {way[-1]}"
        )


def _without_doubles(topics: list[ros_bags.Topic]) -> list[ros_bags.Topic]:
    """Of each camera one transport: raw images where there are some."""
    by_base = {t.base: t for t in sorted(topics, key=lambda t: t.raw)}
    return [t for t in topics if t in by_base.values()]


def _several(role: str, topics: list[str], first: str) -> ImportSourceError:
    return ImportSourceError(
        f"several topics fit the {role}: {', '.join(topics[: ros_bags.LISTED])}; name one: --topic {role}={first}"
    )


def _info_name(topic: ros_bags.Topic) -> str:
    return f"{topic.base.rsplit('/', 1)[0]}/camera_info"


def _span(stamps_ns: NDArray[np.int64]) -> str:
    return f"{stamps_ns.min() / 1e9:.3f} to {stamps_ns.max() / 1e9:.3f} s"


def _one_lens(a: CameraIntrinsics, b: CameraIntrinsics) -> bool:
    """Whether two calibrations are of one lens, at any size of its image."""
    if not same_view((a.width, a.height), (b.width, b.height)):
        return False
    b = scale_intrinsics(b, a.width, a.height)
    focal = max(abs(a.fx - b.fx) / a.fx, abs(a.fy - b.fy) / a.fy)
    return focal < _SAME_LENS and max(abs(a.cx - b.cx), abs(a.cy - b.cy)) < _SAME_LENS * a.width
