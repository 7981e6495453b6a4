"""Gathers views of the board from all sources: recorded ones one after the other, live ones at once."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import structlog

from semantic_mapper.drivers.calibrating.config import CalibrationConfig
from semantic_mapper.drivers.calibrating.views import ViewGatherer, simultaneous
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.errors import CameraError, SemanticMapperError
from semantic_mapper.nodes.calibration.sources import Source
from semantic_mapper.nodes.console import frame_progress
from semantic_mapper.nodes.process import StopRequest

TELL_S = 2.0
SPARE_INSTANTS = 4  # live rigs: beyond those needed

_log = structlog.get_logger(__name__)


class Gathering:
    """The views of all cameras.

    Args:
        board, config: See ``ViewGatherer``.

    Attributes:
        cameras: By name, in the order in which they came; ``known``: those whose intrinsics are right as told.
    """

    def __init__(self, board: BoardPoses, config: CalibrationConfig) -> None:
        self.cameras: dict[str, ViewGatherer] = {}
        self.known: set[str] = set()
        self._board = board
        self._config = config
        self._mutex = threading.Lock()

    def run(self, sources: Sequence[Source], stop: StopRequest, seconds: float, *, rig: bool) -> None:
        """Take in all images; of live cameras, until there is enough of them, the time is over, or a stop request.

        Raises:
            CameraError, LogError: a source fails.
        """
        for source in sources:
            if not source.live:
                with frame_progress("looked at", None, "images") as bar:
                    self._take_all(source, bar.advance, stop)
        live = [source for source in sources if source.live]
        if live and not stop:
            self._listen(live, stop, seconds, rig=rig)

    def lacks(self, *, rig: bool) -> list[str]:
        """What is still missing, as sentences with the camera's name."""
        lacks_text = [f"{name}: {lack}" for name, views in list(self.cameras.items()) for lack in views.lacks()]
        if rig:
            shared = len(simultaneous({n: list(v.steady) for n, v in list(self.cameras.items())}, self._config))
            needed = self._config.min_instants + SPARE_INSTANTS
            if shared < needed:
                lacks_text.append(
                    f"{shared} moments at which several cameras saw the board held still; {needed} are awaited"
                )
        return lacks_text

    def _take_all(self, source: Source, advance: Callable[[], None], stop: StopRequest) -> None:
        for name, image in source.images():
            self._camera(image.camera_id, source).take(image, name)
            advance()
            if stop:
                return

    def _camera(self, camera_id: str, source: Source) -> ViewGatherer:
        with self._mutex:
            if camera_id not in self.cameras:
                self.cameras[camera_id] = ViewGatherer(self._board, self._config, stream=source.stream)
                if source.known:
                    self.known.add(camera_id)
            return self.cameras[camera_id]

    def _listen(self, sources: Sequence[Source], stop: StopRequest, seconds: float, *, rig: bool) -> None:
        """Raises: CameraError: a camera cannot be opened or fails."""
        errors: list[SemanticMapperError] = []

        def work(source: Source) -> None:
            try:
                self._take_all(source, lambda: None, stop)
            except SemanticMapperError as error:
                errors.append(error)

        threads = [threading.Thread(target=work, args=(s,), name="calibration", daemon=True) for s in sources]
        for thread in threads:
            thread.start()
        deadline, last_sent = time.monotonic() + seconds, 0.0
        while not stop and not errors and time.monotonic() < deadline and any(t.is_alive() for t in threads):
            time.sleep(0.1)
            if time.monotonic() - last_sent < TELL_S:
                continue
            last_sent = time.monotonic()
            lacks = self.lacks(rig=rig) if len(self.cameras) >= len(sources) else ["waiting for images"]
            kept = {name: len(views.kept) for name, views in list(self.cameras.items())}
            _log.info("views", **kept, lacking="; ".join(lacks) or "nothing")
            if not lacks:
                break
        for source in sources:
            source.stop()
        for thread in threads:
            thread.join(5.0)
        if errors:
            raise CameraError(str(errors[0])) from errors[0]
