"""The Ray cluster that work runs on: one of this machine alone, or one that is there."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from semantic_mapper.errors import DependencyError


@contextmanager
def connected(address: str | None) -> Iterator[None]:
    """Connected with a cluster while inside.

    Args:
        address: None or ``local`` starts one on this machine.

    Raises:
        DependencyError: Ray is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise DependencyError(f'{error}; pip install "semantic-mapper[fleet]"') from error
    where: dict[str, Any] = {} if address in (None, "local") else {"address": address}
    ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.WARNING, **where)
    try:
        yield
    finally:
        ray.shutdown()
