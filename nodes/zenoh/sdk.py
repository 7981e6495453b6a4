"""Zenoh's package, which is an extra: import it from here.

Raises:
    DependencyError: on import, where the extra is not installed.
"""

from __future__ import annotations

from semantic_mapper.errors import DependencyError

try:
    import zenoh
except ModuleNotFoundError as error:
    raise DependencyError(
        "nodes of kind 'zenoh' need the package eclipse-zenoh: pip install 'semantic-mapper[zenoh]'"
    ) from error

__all__ = ["zenoh"]
