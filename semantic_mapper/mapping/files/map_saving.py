"""Saving a map while frames go on changing it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from semantic_mapper.localization.places import Place
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.files.map_file import BlockPart, write_map
from semantic_mapper.mapping.files.map_manifest import CHUNK_BLOCKS, MapManifest
from semantic_mapper.mapping.instance_layer import InstanceLayer
from semantic_mapper.mapping.storage.block_grid import BlockGrid
from semantic_mapper.mapping.storage.block_index import unpack_keys
from semantic_mapper.mapping.storage.grid_snapshots import GridSnapshots

_log = get_logger(__name__)


class MapSaving:
    """The map as it was when this was made; to be written once, by whichever thread.

    Until it is written, blocks that frames change are put aside first: write it soon.

    Args:
        locked: Gives the storage of the map, alone; it is held while this is made.
        manifest: Settings, classes and counters of the map.
        instances: Which voxels belong to which thing, if the map says so.
        places: What the map is found again by.
    """

    def __init__(
        self,
        locked: Callable[[], AbstractContextManager[BlockGrid]],
        manifest: MapManifest,
        instances: InstanceLayer | None = None,
        places: tuple[Place, ...] = (),
    ) -> None:
        self._locked = locked
        self._manifest = manifest
        self._instances = instances
        self._places = places
        with locked() as grid:
            self._snapshots = GridSnapshots(grid)

    def write(self, path: Path, between: Callable[[], object] = lambda: None) -> None:
        """Write the file, whole or not at all, in memory for ``CHUNK_BLOCKS``.

        Args:
            path: Of the file.
            between: Called after every ``CHUNK_BLOCKS``, without the lock; an error of its own ends the writing.

        Raises:
            MapError: the file cannot be written; one that was there before is as it was.
        """
        try:
            manifest = write_map(path, self._manifest, self._parts(between), self._instances, self._places)
        finally:
            with self._locked():
                self._snapshots.close()
        _log.info(
            "map_saved", path=str(path), frames=manifest.frames, blocks=manifest.blocks, bytes=path.stat().st_size
        )

    def _parts(self, between: Callable[[], object]) -> Iterator[BlockPart]:
        keys = self._snapshots.keys
        for start in range(0, len(keys), CHUNK_BLOCKS):
            part = keys[start : start + CHUNK_BLOCKS]
            with self._locked():
                values = self._snapshots.read(part)
                self._snapshots.release(part)
            yield unpack_keys(part), values
            between()
