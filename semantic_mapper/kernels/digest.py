"""Which sources a compiled library belongs to; without imports of ours, since the build reads it."""

import hashlib
from pathlib import Path


def source_digest(sources: Path) -> str:
    """Digest of all C files of a folder, which the library compiled from them carries."""
    digest = hashlib.sha256()
    for path in sorted(sources.glob("*.[ch]")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
