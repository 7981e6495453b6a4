"""Reading what an arm has kept on disk: what is damaged is made again, and the log says why."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import TypeVar

import msgspec
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from semantic_mapper.log_events import get_logger

_log = get_logger(__name__)

# What ``np.load`` and the arrays of its file raise where that is damaged.
NPZ_ERRORS = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)

ValueT = TypeVar("ValueT")


def read_network(path: Path, net: nn.Module) -> bool:
    """Give ``net`` the weights kept in a file, ready to predict; False where it has none that can be read."""
    if not path.exists():
        return False
    try:
        weights = load_file(path)
    except (OSError, SafetensorError) as error:
        warn_unreadable(path, error)
        return False
    net.load_state_dict(weights)
    net.eval()
    return True


def read_json(path: Path, kind: type[ValueT]) -> ValueT | None:
    """What is kept in a JSON file; None where it has nothing that can be read."""
    if not path.exists():
        return None
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (OSError, msgspec.DecodeError) as error:
        warn_unreadable(path, error)
        return None


def warn_unreadable(path: Path, error: Exception) -> None:
    """Say that a kept file is damaged and is made again."""
    _log.warning("kept_file_unreadable", file=str(path), error=str(error))
