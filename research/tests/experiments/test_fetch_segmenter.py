from __future__ import annotations

from pathlib import Path

import pytest

from research.experiments import fetch_segmenter


@pytest.mark.parametrize(
    ("npm", "message"),
    [
        (None, "`npm pack .*: No such file or directory; install Node.js"),
        ("echo npm error code ENOTFOUND >&2; exit 1", "check the network .*: npm error code ENOTFOUND"),
        ("echo half > package.tgz", "npm gave [0-9a-f]{64} for .* the download is damaged .* try again"),
        ("exit 0", "npm gave no archive"),
    ],
)
def test_why_nothing_was_fetched_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, npm: str | None, message: str
) -> None:
    if npm is not None:
        (tmp_path / "npm").write_text(f"#!/bin/sh\n{npm}\n")
        (tmp_path / "npm").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("sys.argv", ["fetch_segmenter", str(tmp_path / "out")])
    with pytest.raises(SystemExit, match=message):
        fetch_segmenter.main()
    assert not any((tmp_path / "out").iterdir())
