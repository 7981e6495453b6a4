"""Bytes of the wire and of logs: recorded bytes mean the same now, and the same values become the same bytes.

Bytes may change with a version of the protocol, or of the libraries in uv.lock that pack PNG and zstd.
"""

from base64 import b64decode
from typing import Any

import numpy as np
import pytest

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.queries.questions import QUESTIONS, decode_answer, decode_question, encode_answer, encode_request
from semantic_mapper.transport.codec import decode, encode
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.messages import TOPICS
from semantic_mapper.transport.pose_message import decode_pose, encode_pose
from semantic_mapper.types import PosedFrame
from tests.contract.golden import differences, meaning, parts_of, plain, read

JPEG_LEVELS = 1.0  # of 256, mean difference: another decoder rounds otherwise; swapped channels are 50 apart

_WIRE: dict[str, Any] = read("wire")
_MESSAGES, _QUESTIONS, _ANSWERS = _WIRE["messages"], _WIRE["questions"], _WIRE["answers"]


def test_every_topic_and_question_is_held() -> None:
    assert {entry["topic"] for entry in _MESSAGES.values()} >= set(TOPICS)
    assert set(_QUESTIONS) >= set(QUESTIONS) and set(_ANSWERS) >= set(QUESTIONS)
    assert set(_WIRE["topics"]) <= set(TOPICS)
    for name, row in _WIRE["topics"].items():
        assert differences(row, plain_topic(name)) == []


def plain_topic(name: str) -> dict[str, Any]:
    """What subscribers and logs rely on."""
    topic = TOPICS[name]
    return {"queue": topic.queue, "latched": topic.latched, "logged": topic.logged, "closes": topic.closes}


@pytest.mark.parametrize("name", _MESSAGES)
def test_golden_bytes_mean_what_they_meant(name: str) -> None:
    entry = _MESSAGES[name]
    message = decode(parts_of(entry["parts"]))
    assert differences(entry["says"], masked(name, message)) == []
    if "jpeg" in name:
        pixels = np.frombuffer(b64decode(entry["pixels"]), np.uint8).reshape(12, 16, 3)
        assert isinstance(message, PosedFrame)
        assert np.abs(message.rgb.astype(float) - pixels).mean() < JPEG_LEVELS


def masked(name: str, message: Any) -> Any:
    """Without pixels of JPEG, whose decoders may round otherwise."""
    said = plain(message)
    if "jpeg" in name:
        del said["rgb"]["digest"]
    return said


@pytest.mark.parametrize("name", [name for name, entry in _MESSAGES.items() if entry["exact"]])
def test_values_become_the_golden_bytes(name: str) -> None:
    entry = _MESSAGES[name]
    parts = parts_of(entry["parts"])
    message = decode(parts)
    assert encode(message, CodecOptions(**entry["options"])) == parts


@pytest.mark.parametrize("name", _QUESTIONS)
def test_golden_questions_mean_what_they_meant(name: str) -> None:
    parts = parts_of(_QUESTIONS[name]["parts"])
    request = decode_question(parts)
    assert differences(_QUESTIONS[name]["says"], plain(request)) == []
    if _QUESTIONS[name]["exact"]:
        assert encode_request(_QUESTIONS[name]["kind"], request) == parts


@pytest.mark.parametrize("name", _ANSWERS)
def test_golden_answers_mean_what_they_meant(name: str) -> None:
    kind, parts = _ANSWERS[name]["kind"], parts_of(_ANSWERS[name]["parts"])
    state, answer = decode_answer(kind, QUESTIONS[kind].answer, parts)
    assert differences(_ANSWERS[name]["says"], plain((state, answer))) == []
    if _ANSWERS[name]["exact"]:
        assert encode_answer(kind, state, answer) == parts


@pytest.mark.parametrize("name", _WIRE["errors"])
def test_a_golden_error_is_raised_by_its_class(name: str) -> None:
    with pytest.raises(SemanticMapperError, match=r"^the box is empty$") as raised:
        decode_answer("at", QUESTIONS["at"].answer, parts_of(_WIRE["errors"][name]["parts"]))
    assert type(raised.value).__name__ == _WIRE["errors"][name]["raises"]


@pytest.mark.parametrize("name", _WIRE["poses"])
def test_a_golden_pose_message_means_what_it_meant(name: str) -> None:
    entry = _WIRE["poses"][name]
    message = decode_pose(parts_of(entry["parts"]))
    assert differences(entry["says"], {**meaning(message), "matrix": plain(message.matrix)}) == []
    if entry["exact"]:
        assert encode_pose(message) == parts_of(entry["parts"])
