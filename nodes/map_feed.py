"""Maps for other tools: fetched again and again, and in plain forms."""

import threading
import time
from collections.abc import Callable
from typing import Any, Self

import numpy as np
import structlog

from semantic_mapper.client import MapClient
from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.queries.objects import ObjectChange
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.types import UInt8

MAX_POINTS = 400_000  # of a map that is shown again and again: of a larger one every second point, or third, ...
# One point: world metres, colour, class id, confidence in 255ths, 1 where a sensor measured it, else 0, one spare.
POINT = np.dtype(
    [(axis, "<f4") for axis in ("x", "y", "z")]
    + [(name, "u1") for name in ("red", "green", "blue", "alpha", "label", "confidence", "measured", "spare")]
)

_log = structlog.get_logger(__name__)


class MapFollower:
    """Looks at a map again and again, in a thread of its own, and once more at the end; a context manager.

    ``look`` may raise errors of ours: a mapper that starts has no map for a while. Between two looks are ``refresh_s``
    at least, and ``pause`` times as long as the last one took.
    """

    def __init__(self, look: Callable[[], None], refresh_s: float, pause: float = 0.0) -> None:
        self.trouble = ""  # why the last look failed
        self._look = look
        self._refresh_s = refresh_s
        self._pause = pause
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="map", daemon=True)

    @property
    def alive(self) -> bool:
        """Whether it still looks; False before its end only by a bug."""
        return self._thread.is_alive()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        ended, pause_s = False, 0.0
        while not ended:
            ended = self._ended.wait(max(self._refresh_s, pause_s))
            began = time.monotonic()
            try:
                self._look()
                self.trouble, pause_s = "", self._pause * (time.monotonic() - began)
            except SemanticMapperError as error:
                if not (self.trouble or ended):
                    _log.warning("map_not_shown", reason=str(error))
                self.trouble, pause_s = str(error), 0.0


def follow_changes(client: MapClient) -> Callable[[], tuple[ObjectChange, ...]]:
    """What gives the changes since the map that a mapper goes on in, as ``MapClient.objects`` does, or those before
    where there is no answer; of one that goes on in none it asks but once."""
    goes_on, known = True, ()

    def changes() -> tuple[ObjectChange, ...]:
        nonlocal goes_on, known
        if goes_on:
            try:
                memory = client.objects()
            except SemanticMapperError as error:
                _log.debug("changes_not_shown", reason=str(error))
            else:
                goes_on, known = memory.since_ns > 0, memory.changes
        return known

    return changes


def thinning(count: int) -> int:
    """Of so many points every n-th one is shown, so that there are at most ``MAX_POINTS``."""
    return max(1, -(-count // MAX_POINTS))


def thinned(points: MapPoints) -> MapPoints:
    """Every n-th point; see ``thinning``."""
    step = thinning(len(points.xyz))
    measured = None if points.measured is None else points.measured[::step]
    return MapPoints(points.xyz[::step], points.rgb[::step], points.label[::step], points.confidence[::step], measured)


def pack_points(points: MapPoints, rgb: UInt8) -> bytes:
    """Records of ``POINT``, with colours (N, 3)."""
    packed = np.zeros(len(points.xyz), POINT)
    for names, columns in (("x", "y", "z"), points.xyz), (("red", "green", "blue"), rgb):
        for column, name in enumerate(names):
            packed[name] = columns[:, column]
    packed["alpha"] = 255
    packed["label"] = points.label
    packed["confidence"] = np.rint(points.confidence * 255)
    packed["measured"] = 1 if points.measured is None else points.measured
    return packed.tobytes()


def describe_map(snapshot: MapSnapshot, count: int, stamp_ns: int) -> dict[str, Any]:
    """What a map of ``count`` points before thinning is, for JSON; ``stamp_ns`` of the newest frame heard of."""
    labels = snapshot.label_set
    classes = zip(labels.ids, labels.names, labels.colors, strict=True)
    return {
        "stamp_ns": stamp_ns,
        "version": snapshot.version,
        "epoch": snapshot.epoch,
        "voxel_size_m": snapshot.voxel_size_m,
        "scale_known": snapshot.scale_known,
        "points": -(-count // thinning(count)),
        "every_nth": thinning(count),
        "label_set": labels.name,
        "unknown_id": labels.ignore_id,
        "classes": [{"id": i, "name": name, "color": list(color)} for i, name, color in classes],
    }
