"""Debian packages unpacked into a folder of this project: no root, and nothing of the system is changed."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from tools.system_libs import apt


def unpack_packages(packages: tuple[str, ...], tree: Path, what: str) -> str:
    """Unpack packages, and those they depend on that the system lacks, into ``tree``.

    Args:
        packages: Their names.
        tree: Made again, whole or not at all.
        what: They are, for people.

    Returns:
        Why that cannot be done; empty where it is.
    """
    if not shutil.which("apt-get") or not shutil.which("dpkg-deb"):
        return f"this system has no apt-get and dpkg-deb to fetch {what} with"
    print(f"fetching {what} ...", flush=True)
    with tempfile.TemporaryDirectory(prefix="packages-") as folder:
        scratch = Path(folder)
        for name in ("lists/partial", "cache/archives/partial", "deb"):
            (scratch / name).mkdir(parents=True)
        update = apt("update", scratch)
        listed = apt("install", scratch, "--print-uris", "-y", "--no-install-recommends", "--reinstall", *packages)
        names = sorted(set(re.findall(r"^'\S+' ([^_\s]+)_", listed.stdout, re.MULTILINE)))
        if update.returncode != 0 or not names:
            return f"no packages: {(update.stderr + listed.stderr).strip()}"
        download = apt("download", scratch, *names)
        if download.returncode != 0:
            return f"apt-get download failed: {download.stderr.strip()}"
        partial = tree.with_name(f"{tree.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        for archive in (scratch / "deb").glob("*.deb"):
            subprocess.run(["dpkg-deb", "-x", archive, partial], check=True)
    partial.rename(tree)
    return ""


def library_path(tree: Path) -> str:
    """``LD_LIBRARY_PATH`` for programs of such a tree."""
    folders = sorted({str(path.parent) for path in tree.glob("**/lib/**/*.so*") if path.is_file()})
    return ":".join(folder for folder in folders if "/site-packages/" not in folder)
