"""Where results go is made sure of before minutes are spent on them."""

from __future__ import annotations

from pathlib import Path

from semantic_mapper.errors import ConfigError


def prepare_file(path: Path) -> None:
    """Make sure that a file can be written, before minutes are spent on what is to be in it.

    Raises:
        ConfigError: it is a folder, or nothing can be written beside it.
    """
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; give the name of a file")
    prepare_folder(path.parent)


def prepare_folder(out: Path) -> None:
    """Make the folder for results, before minutes are spent on them.

    Raises:
        ConfigError: it cannot be made or written to.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ConfigError(f"{out}: cannot hold the results ({error.strerror}); choose another folder") from error
