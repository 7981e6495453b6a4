"""Which code makes a result: a digest that decides whether results are the same, and a name for people."""

from __future__ import annotations

import hashlib
import os
import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path

import semantic_mapper

_PACKAGE = Path(semantic_mapper.__file__).parent
_SUFFIXES = (".py", ".c", ".h", ".jinja", ".js")
# Of what computes: another version may give other figures.
_PACKAGES = ("torch", "numpy", "scipy", "open3d", "opencv-contrib-python-headless")


@cache
def code_digest() -> str:
    """SHA-256 over the sources of the package, and the versions of the packages that compute."""
    digest = hashlib.sha256()
    for name in _PACKAGES:
        digest.update(f"{name} {metadata.version(name)}\n".encode())
    for folder, subfolders, files in os.walk(_PACKAGE, followlinks=True):  # drivers, nodes and replay are links
        subfolders[:] = sorted(s for s in subfolders if s not in ("__pycache__", "weights"))
        for name in sorted(files):
            if name.endswith(_SUFFIXES):
                path = Path(folder) / name
                data = path.read_bytes()
                digest.update(f"{path.relative_to(_PACKAGE)} {len(data)}\n".encode())
                digest.update(data)
    return digest.hexdigest()


@cache
def code_version() -> str:
    """Version and, in a checkout, git revision, such as ``0.1.0+g1a2b3c4d`` or ``0.1.0+g1a2b3c4d-dirty``."""
    revision = git_revision(_PACKAGE)
    if revision is None:
        return semantic_mapper.__version__
    commit, _, dirty = revision.partition("-")
    return f"{semantic_mapper.__version__}+g{commit[:8]}{'-dirty' if dirty else ''}"


def git_revision(package: Path) -> str | None:
    """Commit of the checkout whose top folder holds ``package``, with "-dirty" where files differ from it.

    None where the package is installed rather than checked out, or where git is missing.
    """
    top = _git(package, "rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() != package.parent:
        return None
    return _git(package, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=False, timeout=30
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
