from __future__ import annotations

from pathlib import Path

import pytest

from semantic_mapper.errors import CodecError, TransportError
from semantic_mapper.transport.endpoints import default_endpoint
from semantic_mapper.transport.topics import TOPICS, parse_topic, subscription, topic_bytes


def test_default_endpoints_are_the_same_for_all_processes_and_differ_by_name(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    one, other = default_endpoint("camera"), default_endpoint("camera", "test")
    assert one == default_endpoint("camera") == f"ipc://{tmp_path}/semantic-mapper/default/camera"
    assert other != one
    assert (tmp_path / "semantic-mapper").stat().st_mode & 0o077 == 0


def test_default_endpoints_fall_back_to_a_folder_of_the_user(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert default_endpoint("mapper").startswith(f"ipc://{tmp_path}/semantic-mapper-")


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "a b"])
def test_a_name_that_would_leave_the_folder_is_refused(name: str) -> None:
    with pytest.raises(TransportError):
        default_endpoint(name)


def test_a_subscription_matches_whole_words_only() -> None:
    assert topic_bytes("frame", "front").startswith(subscription("frame", "front"))
    assert not topic_bytes("frame", "frontal").startswith(subscription("frame", "front"))


def test_topics_are_read_back() -> None:
    for name in TOPICS:
        assert parse_topic(topic_bytes(name, "cam-1.left:a_b")) == (TOPICS[name], "cam-1.left:a_b")


@pytest.mark.parametrize(
    "topic", [b"", b"frame", b"frame/", b"frame/a", b"frame/a/b", b"frames/a/", b"\xff/a/", b"frame/ /"]
)
def test_foreign_topics_are_refused(topic: bytes) -> None:
    with pytest.raises(CodecError):
        parse_topic(topic)
