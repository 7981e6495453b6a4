"""A Zenoh session: what a launch publishes, as JPEG, PNG, plain arrays and JSON.

Images and poses are dropped for a client that does not keep up. Maps and graphs wait for it, for five seconds at most:
then Zenoh cuts the connection, and the client connects again. What nobody subscribes to is not even encoded.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from types import TracebackType
from typing import Any, Literal, Self

import msgspec
import numpy as np
import structlog

from semantic_mapper.errors import TransportError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.nodes.bridge.feed import Subject
from semantic_mapper.nodes.bridge.packing import describe_pose, moving_mask, pack_points, to_jpeg, to_png
from semantic_mapper.nodes.map_answers import answer_graph
from semantic_mapper.nodes.options import ZenohOptions
from semantic_mapper.nodes.zenoh.addresses import zenoh_settings
from semantic_mapper.nodes.zenoh.sdk import zenoh
from semantic_mapper.queries.graph import SceneGraph
from semantic_mapper.transport.messages import Status
from semantic_mapper.types import Float64, MapUpdate, PosedFrame

MAX_QUERIES = 64  # that wait for a map or graph ...
QUERY_S = 60.0  # ... for so long; by default Zenoh itself gives them up after 10 s
KEYS: dict[Subject, str] = {"map": "map/points", "graph": "graph"}
JSON, JPEG, PNG = zenoh.Encoding.APPLICATION_JSON, zenoh.Encoding.IMAGE_JPEG, zenoh.Encoding.IMAGE_PNG
BYTES = zenoh.Encoding.APPLICATION_OCTET_STREAM

_log = structlog.get_logger(__name__)


class ZenohSession:
    """An ``Outlet`` that publishes to Zenoh; a context manager.

    Args:
        options: Where, and under which keys.

    Raises:
        ConfigError, TransportError: see ``zenoh_settings``; or the address is taken.
    """

    def __init__(self, options: ZenohOptions) -> None:
        config = zenoh.Config()
        for key, value in zenoh_settings(options).items():
            config.insert_json5(key, json.dumps(value))
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            where = " and ".join(filter(None, (options.listen, options.connect)))
            raise TransportError(
                f"Zenoh cannot use {where}: {error}; give another address, or free this one"
            ) from error
        self._prefix = options.prefix
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._lock = threading.Lock()
        self._joined: dict[Subject, int] = {"map": 0, "graph": 0}
        self._there: dict[Subject, bool] = {"map": False, "graph": False}
        self._queries: dict[Subject, list[tuple[float, zenoh.Query]]] = {"map": [], "graph": []}
        for subject, key in KEYS.items():
            self._declare(key, subject)
            self._session.declare_queryable(f"{self._prefix}/{key}", partial(self._take_query, subject))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._session.close()
        except zenoh.ZError as failure:  # what is connected is cut off all the same
            _log.warning("session_not_closed", reason=str(failure))

    def asked(self, subject: Subject) -> int:
        """See ``Outlet``."""
        matches = _has_subscribers(self._publishers[KEYS[subject]])
        with self._lock:
            self._joined[subject] += matches and not self._there[subject]
            self._there[subject] = matches
            now = time.monotonic()
            self._queries[subject] = [(at, query) for at, query in self._queries[subject] if now - at < QUERY_S]
            return self._joined[subject] if matches or self._queries[subject] else 0

    def send_labels(self, label_set: LabelSet) -> None:
        """Class ids have their names in what is attached to the map."""

    def wants(self, topic: Literal["frame", "map"], camera_id: str) -> bool:
        """See ``Outlet``."""
        kinds = ("rgb", "depth", "pose") if topic == "frame" else ("semantics", "moving")
        return any(self._wanted(f"{camera_id}/{kind}") is not None for kind in kinds)

    def note_pose(self, camera_id: str, T_map_camera: Float64) -> None:
        """Poses go out with the frames."""

    def send_frame(self, frame: PosedFrame, T_map_camera: Float64 | None) -> None:
        """See ``Outlet``."""
        about = describe_pose(frame, T_map_camera)
        camera = frame.camera_id
        if T_map_camera is not None and (pose := self._wanted(f"{camera}/pose")) is not None:
            _put(pose, _json(about), JSON)
        if (rgb := self._wanted(f"{camera}/rgb")) is not None:
            _put(rgb, to_jpeg(frame.rgb), JPEG, _json(about))
        if frame.depth_m is not None and (depth := self._wanted(f"{camera}/depth")) is not None:
            data = np.ascontiguousarray(frame.depth_m, "<f4").tobytes()
            _put(depth, data, BYTES, _json(about))

    def send_update(self, update: MapUpdate) -> None:
        """See ``Outlet``."""
        about = {"stamp_ns": update.stamp_ns, "seq": update.seq, "camera": update.camera_id}
        if (semantics := self._wanted(f"{update.camera_id}/semantics")) is not None:
            _put(semantics, to_png(update.label), PNG, _json(about))
        if (moving := self._wanted(f"{update.camera_id}/moving")) is not None:
            _put(moving, to_png(moving_mask(update)), PNG, _json(about))

    def send_status(self, status: Status) -> None:
        """See ``Outlet``."""
        if (publisher := self._wanted(f"status/{status.node}")) is not None:
            _put(publisher, msgspec.json.encode(status), JSON)

    def send_map(self, points: MapPoints, about: dict[str, Any]) -> None:
        """See ``Outlet``."""
        self._answer("map", pack_points(points, points.rgb), BYTES, _json(about))

    def send_graph(self, graph: SceneGraph, stamp_ns: int) -> None:
        """See ``Outlet``."""
        self._answer("graph", _json({"stamp_ns": stamp_ns, **answer_graph(graph)}), JSON, None)

    def _declare(self, key: str, subject: Subject | None = None) -> zenoh.Publisher:
        """The publisher of a key: old images are of no use, maps are worth waiting for."""
        control, priority = zenoh.CongestionControl.DROP, zenoh.Priority.DATA
        if subject is not None:
            control, priority = zenoh.CongestionControl.BLOCK, zenoh.Priority.BACKGROUND
        with _explained():
            publisher = self._session.declare_publisher(
                f"{self._prefix}/{key}", congestion_control=control, priority=priority
            )
        self._publishers[key] = publisher
        return publisher

    def _wanted(self, key: str) -> zenoh.Publisher | None:
        """The publisher of a key that somebody subscribes to."""
        publisher = self._publishers.get(key) or self._declare(key)
        return publisher if _has_subscribers(publisher) else None

    def _take_query(self, subject: Subject, query: zenoh.Query) -> None:
        """Keep a ``get`` until there is an answer; called by Zenoh's threads."""
        with self._lock:
            self._joined[subject] += 1
            self._queries[subject] = [*self._queries[subject], (time.monotonic(), query)][-MAX_QUERIES:]

    def _answer(self, subject: Subject, payload: bytes, encoding: zenoh.Encoding, attachment: bytes | None) -> None:
        with self._lock:
            queries, self._queries[subject] = self._queries[subject], []
        for _, query in queries:
            try:
                query.reply(f"{self._prefix}/{KEYS[subject]}", payload, encoding=encoding, attachment=attachment)
            except zenoh.ZError as error:  # who asked has gone
                _log.info("not_answered", key=KEYS[subject], reason=str(error))
        publisher = self._publishers[KEYS[subject]]
        if _has_subscribers(publisher):
            _put(publisher, payload, encoding, attachment)


@contextmanager
def _explained() -> Iterator[None]:
    """Errors of Zenoh as ours.

    Raises:
        TransportError: its session has ended.
    """
    try:
        yield
    except zenoh.ZError as error:
        raise TransportError(f"Zenoh sends nothing any more: {error}; start the node again") from error


def _put(publisher: zenoh.Publisher, payload: bytes, encoding: zenoh.Encoding, attachment: bytes | None = None) -> None:
    with _explained():
        publisher.put(payload, encoding=encoding, attachment=attachment)


def _has_subscribers(publisher: zenoh.Publisher) -> bool:
    with _explained():
        status: Any = publisher.matching_status  # the package's stubs say bool, which is wrong
    return bool(status.matching)


def _json(plain: Any) -> bytes:
    return msgspec.json.encode(plain)
