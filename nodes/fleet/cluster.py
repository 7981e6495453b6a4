"""The Ray cluster that work runs on: one of this machine alone, or one that is there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

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
    at = None if address in (None, "local") else address
    ray.init(address=at, include_dashboard=False, log_to_driver=False)
    try:
        yield
    finally:
        ray.shutdown()
