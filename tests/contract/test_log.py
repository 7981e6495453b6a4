"""A log of then: it is read, described, replayed, and mended where it was cut off."""

import json
from pathlib import Path
from typing import Any

import mcap.reader
import pytest

from semantic_mapper.replay.log.format import LogReader, LogWriter
from tests.contract import entry_points as api
from tests.contract.golden import FRAMES, LOG, REFUSED_SEQ, WEIGHTS, differences, form, lacking, plain, read

CUT_BYTES = 20_000  # from the end: less than one frame


def observe(_: Path) -> dict[str, Any]:
    """What the log says, by our reader, and by MCAP's own."""
    with LogReader(LOG) as log:
        frames = [plain(frame) for frame in log]
        info = plain(log.info)
        state = {"finished": log.finished, "errors": len(log.errors), "attachments": len(log.attachments())}
        parts = [plain(p) for _, p in log.messages()]
    with LOG.open("rb") as file:
        summary = mcap.reader.make_reader(file).get_summary()
    assert summary is not None
    channels = [[c.topic, c.message_encoding, summary.schemas[c.schema_id].name] for c in summary.channels.values()]
    told = json.loads(api.run_here("info", LOG, "--json").stdout)
    values = {key: told[key] for key in ("frames", "frames_with_depth", "frames_with_labels", "source", "topics")}
    return {
        "frames": frames, "info": info, "state": state, "parts": parts, "channels": channels,
        "described": values, "described_form": form(told),
    }  # fmt: skip


def test_a_golden_log_says_what_it_said(tmp_path: Path) -> None:
    then, now = read("log"), observe(tmp_path)
    assert lacking(then.pop("described_form"), now.pop("described_form")) == []
    assert differences(then, now) == []
    assert len(then["frames"]) == FRAMES


def test_a_log_is_written_with_the_same_channels(tmp_path: Path) -> None:
    with LogReader(LOG) as log, LogWriter(tmp_path / "again.mcap", log.info) as again:
        for frame in log:
            again.write_frame(frame)
    with (tmp_path / "again.mcap").open("rb") as file:
        summary = mcap.reader.make_reader(file).get_summary()
    assert summary is not None
    channels = [[c.topic, c.message_encoding, summary.schemas[c.schema_id].name] for c in summary.channels.values()]
    assert channels == read("log")["channels"]
    with LogReader(LOG) as log, LogReader(tmp_path / "again.mcap") as copy:
        for one, other in zip(log, copy, strict=True):
            assert plain(one) == plain(other)


@pytest.mark.parametrize("cut", [CUT_BYTES, 0], ids=["truncated", "damaged"])
def test_a_spoiled_log_is_told_of_and_mended(cut: int, tmp_path: Path) -> None:
    data = bytearray(LOG.read_bytes())
    if cut:
        del data[-cut:]
    else:
        data[len(data) // 2] ^= 0xFF
    log, mended = tmp_path / "spoiled.mcap", tmp_path / "mended.mcap"
    log.write_bytes(data)
    described = api.run_here("info", log, "--json")
    told = json.loads(described.stdout)
    assert told["finished"] == (not cut) and bool(told["damage"]) and described.code == 1
    assert api.run_here("import", log, mended).code == 0
    with LogReader(mended) as clean, LogReader(LOG) as whole:
        kept, there = {f.seq: plain(f) for f in clean}, {f.seq: plain(f) for f in whole}
        assert clean.finished and not clean.errors and clean.info == whole.info
    assert len(kept) == FRAMES - 1 and all(frame == there[seq] for seq, frame in kept.items())
    assert api.run_here("info", mended).code == 0


def test_a_truncated_log_is_replayed_as_far_as_it_goes(tmp_path: Path) -> None:
    log = tmp_path / "cut.mcap"
    log.write_bytes(LOG.read_bytes()[:-CUT_BYTES])
    more = ("--weights", WEIGHTS, "--voxel-size", "0.1")
    ran = api.run_here("map", log, "--out", tmp_path / "out", *more, "--json")
    assert ran.code == 0, ran.stderr
    summary = json.loads(ran.stdout)
    assert summary["frames"]["fused"] == FRAMES - 2
    assert [r["seq"] for r in summary["refusals"]] == [REFUSED_SEQ]
    assert len(summary["damaged_stretches"]) == 1
