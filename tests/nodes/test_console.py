"""What a terminal shows while a job runs."""

from __future__ import annotations

import pytest
import structlog
from structlog.testing import capture_logs

from semantic_mapper.nodes.console import frame_progress


@pytest.mark.parametrize("level", ["info", "debug"])
def test_what_only_tells_of_progress_breaks_no_bar(
    level: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # as on a terminal
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(level))
    log = structlog.get_logger()
    try:
        with capture_logs() as events:
            with frame_progress("map", 2) as bar:
                bar.set(1)
                log.info("map_saved")
                log.warning("frame_left_out")
            log.info("after")
    finally:
        structlog.reset_defaults()
    verbose = level == "debug"
    assert [event["event"] for event in events] == ["map_saved"] * verbose + ["frame_left_out", "after"]
    shown = capsys.readouterr().err
    assert "left" in shown and "elapsed" in shown
