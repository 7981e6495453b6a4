"""What ``doctor`` says of the packages that are installed."""

from __future__ import annotations

import pytest

from semantic_mapper.nodes.doctor import machine as doctor


def test_packages_are_checked_with_their_versions_and_without_extras(monkeypatch: pytest.MonkeyPatch) -> None:
    requires = ["open3d<0.21,>=0.20", "torch>=2.5", "rich", 'rerun-sdk; extra == "viewer"', "no-such-package>=1"]
    versions = {"open3d": "0.21.0", "torch": "2.5.1+cpu", "rich": "13"}

    def version(name: str) -> str:
        if name not in versions:
            raise doctor.metadata.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(doctor.metadata, "requires", lambda _: requires)
    monkeypatch.setattr(doctor.metadata, "version", version)
    told = " ".join(f"{check.state} {check.found} {check.fix}" for check in doctor._packages())
    assert "open3d 0.21.0, not <0.21,>=0.20" in told and "no-such-package" in told
    assert "torch 2.5.1+cpu, not" not in told and "rerun-sdk" not in told
