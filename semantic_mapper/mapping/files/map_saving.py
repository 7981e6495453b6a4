"""Saving a map while frames go on changing it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.files.map_file import BlockPart, write_map
from semantic_mapper.mapping.files.map_manifest import CHUNK_BLOCKS, MapManifest
from semantic_mapper.mapping.storage.block_grid import BlockGrid
from semantic_mapper.mapping.storage.grid_snapshot import GridSnapshot

_log = get_logger(__name__)


class MapSaving:
    """The map as it was when this was made; to be written once, by whichever thread.

    Until it is written, blocks that frames change are put aside first: write it soon.

    Args:
        locked: Gives the storage of the map, alone; it is held while this is made.
        manifest: Settings, classes and counters of the map.
    """

    def __init__(self, locked: Callable[[], AbstractContextManager[BlockGrid]], manifest: MapManifest) -> None:
        self._locked = locked
        self._manifest = manifest
        with locked() as grid:
            self._snapshot = GridSnapshot(grid, len(manifest.label_set))

    def write(self, path: Path, between: Callable[[], object] = lambda: None) -> None:
        """Write the file, whole or not at all, in memory for ``CHUNK_BLOCKS``.

        Args:
            path: Of the file.
            between: Called after every ``CHUNK_BLOCKS``, without the lock; an error of its own ends the writing.

        Raises:
            MapError: the file cannot be written; one that was there before is as it was.
        """
        try:
            manifest = write_map(path, self._manifest, self._parts(between))
        finally:
            with self._locked():
                self._snapshot.close()
        _log.info(
            "map_saved", path=str(path), frames=manifest.frames, blocks=manifest.blocks, bytes=path.stat().st_size
        )

    def _parts(self, between: Callable[[], object]) -> Iterator[BlockPart]:
        while True:
            with self._locked():
                if not len(self._snapshot):
                    return
                part = self._snapshot.read(CHUNK_BLOCKS)
            yield part
            between()
