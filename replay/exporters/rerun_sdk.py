"""The Rerun SDK, which is an extra: import it from here.

Raises:
    DependencyError: on import, where the extra is not installed.
"""

from __future__ import annotations

from semantic_mapper.errors import DependencyError

try:
    import rerun as rr
    import rerun.blueprint as rrb
except ModuleNotFoundError as error:
    raise DependencyError(
        "the viewer and Rerun files need the package rerun-sdk: pip install 'semantic-mapper[viewer]'"
    ) from error

__all__ = ["rr", "rrb"]
