"""Results for tests of stores."""

from __future__ import annotations

from typing import Any

import msgspec

from semantic_mapper.nodes.fleet.results import Findings, TaskResult


def made_result(key: str, attempt: str = "one", **changes: Any) -> TaskResult:
    result = TaskResult(
        key=key,
        operation="replay",
        log=f"/logs/{key}.mcap",
        log_digest=f"digest of {key}",
        log_bytes=10,
        tags={},
        weights="",
        weights_digest="w",
        settings={},
        version="0.1.0",
        code="c",
        findings=Findings(metrics={"miou": 0.5}),
        files={},
        folder=f"results/{key}/{attempt}",
        attempts=1,
        seconds=1.0,
        node="here",
        finished_ns=1,
    )
    return msgspec.structs.replace(result, **changes)
