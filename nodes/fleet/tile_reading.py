"""A map in tiles, wherever its store is."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from semantic_mapper.errors import ConfigError, MapError
from semantic_mapper.mapping.files.tiles import TILES_NAME, TileRow, parse_tiles
from semantic_mapper.nodes.fleet.urls import is_url, persistently, shown, split_store_url
from semantic_mapper.queries.tiles import TiledMap


def open_tiles(url: str) -> TiledMap:
    """The tiles in a store, which may be named by their manifest; each is fetched to a temporary file when needed.

    Raises:
        ConfigError: there are no tiles.
        MapError: their manifest is damaged.
        StoreError: the store cannot be reached.
    """
    if url.rsplit("/", 1)[-1] == TILES_NAME:
        url = url.removesuffix(TILES_NAME) or "."
    if not is_url(url):
        return TiledMap.open(Path(url))
    url = url.rstrip("/")
    fs, root = split_store_url(url)
    where = f"{shown(url)}/{TILES_NAME}"
    try:
        content = persistently(lambda: fs.cat_file(f"{root}/{TILES_NAME}"), where)
    except FileNotFoundError as error:
        raise ConfigError(
            f"{where}: is missing; give a store that `fleet merge` has written, or a saved map"
        ) from error

    @contextmanager
    def fetch(row: TileRow) -> Iterator[Path]:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "tile.npz"
            try:
                persistently(lambda: fs.get_file(f"{root}/{row.file}", str(file)), f"{shown(url)}/{row.file}")
            except FileNotFoundError as error:
                raise MapError(
                    f"{shown(url)}/{row.file}: this tile is missing; `fleet merge` of the same maps makes it again"
                ) from error
            yield file

    return TiledMap(parse_tiles(content, where), fetch)
