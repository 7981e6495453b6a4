"""What a fleet run settles before it starts: the weights and the settings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from semantic_mapper.config import to_plain
from semantic_mapper.errors import WeightsError
from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint, shipped_checkpoint
from semantic_mapper.fields.nesf import SHIPPED, SMOOTHING, load_nesf
from semantic_mapper.nodes.fleet.code_version import code_digest
from semantic_mapper.nodes.fleet.operations import changed_settings, read_settings
from semantic_mapper.nodes.fleet.scratch import task_folder
from semantic_mapper.nodes.fleet.store import Store, check_result_file
from semantic_mapper.nodes.fleet.urls import is_url, persistently, shown, split_url
from semantic_mapper.nodes.fleet.worker import Task, file_digest, stored_weights

MAX_WEIGHTS_BYTES = 4 << 30


def make_template(
    operation: str,
    store: Store,
    weights: str | None = None,
    assignments: Sequence[str] = (),
    config: Path | None = None,
    disk_bytes: int = 0,
) -> Task:
    """The task that all logs share. Weights from a file are put into the store, for workers elsewhere.

    Raises:
        ConfigError: a setting cannot be used.
        WeightsError: the weights cannot.
        StoreError: they cannot be fetched or stored.
    """
    settings = read_settings(operation, assignments, config)
    name, digest, stored = _find_weights(operation, store, weights)
    return Task(
        operation=operation,
        url="",
        tags={},
        store=store.url,
        settings=to_plain(settings),
        shown_settings=changed_settings(settings),
        weights=name,
        weights_digest=digest,
        weights_stored=stored,
        code=code_digest(),
        disk_bytes=disk_bytes,
    )


def _find_weights(operation: str, store: Store, weights: str | None) -> tuple[str, str, bool]:
    """Name, digest, and whether they are in the store now."""
    refines = operation == "refine"
    if weights is None:
        default = shipped_checkpoint(SHIPPED) if refines else default_checkpoint_path()
        return "", "" if default is None else file_digest(default), False
    if refines and Path(weights) == SMOOTHING:
        return weights, weights, False
    shipped = shipped_checkpoint(Path(weights))
    if shipped is not None and not is_url(weights) and not Path(weights).is_file():
        return weights, file_digest(shipped), False
    name = Path(shown(weights)).name
    fs, path = split_url(weights)
    try:
        size = int(persistently(lambda: fs.info(path), shown(weights)).get("size") or 0)
        if size > MAX_WEIGHTS_BYTES:
            raise WeightsError(f"{shown(weights)}: {size / 1e9:.1f} GB are no weights of ours; check the name")
        with task_folder(size, 0) as folder:
            local = folder / name
            persistently(lambda: fs.get_file(path, str(local)), shown(weights))
            try:
                if refines:
                    load_nesf(local)
                else:
                    load_checkpoint(local)
            except WeightsError as error:
                raise WeightsError(str(error).replace(str(local), shown(weights))) from error
            digest = file_digest(local)
            check_result_file(weights, digest)
            place = stored_weights(digest, name)
            if not store.exists(place):
                store.upload(local, place)
    except FileNotFoundError as error:
        raise WeightsError(f"{shown(weights)}: no such weights") from error
    return name, digest, True
