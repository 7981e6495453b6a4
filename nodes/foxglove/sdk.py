"""The Foxglove SDK, which is an extra: import it from here.

Raises:
    DependencyError: on import, where the extra is not installed.
"""

from __future__ import annotations

from semantic_mapper.errors import DependencyError

try:
    import foxglove
    from foxglove import channels, messages
except ModuleNotFoundError as error:
    raise DependencyError(
        "nodes of kind 'foxglove' need the package foxglove-sdk: pip install 'semantic-mapper[foxglove]'"
    ) from error

__all__ = ["channels", "foxglove", "messages"]
