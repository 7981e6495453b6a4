"""Write the golden data of the contract tests from the code as it is.

    OMP_NUM_THREADS=1 python -m tests.contract.record             # all
    OMP_NUM_THREADS=1 python -m tests.contract.record map wire     # some groups

Golden data says what users have. Record again only what was meant to change, look at `git diff` of the JSON files, and
say in the commit why users can live with it. Maps and other binary files stay: delete one by hand to make it again.
The group ``kitchen`` needs the recording redkitchen (SEMANTIC_MAPPER_SHARED_DATA); only numbers of it
are kept.
"""

import argparse
import importlib
import os
import shutil
import tempfile
from base64 import b64encode
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

from semantic_mapper import errors
from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.queries.questions import (
    QUESTIONS,
    decode_answer,
    decode_question,
    encode_answer,
    encode_error,
    encode_request,
)
from semantic_mapper.testing import LogReplays
from semantic_mapper.transport.codec import decode, encode
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.messages import TOPICS
from semantic_mapper.transport.pose_message import decode_pose
from tests.contract import entry_points as api
from tests.contract import golden, runs, samples
from tests.contract.golden import FOLDER, LOG, MAP, MAP_COARSE, POINTS, STORED, WEIGHTS

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def record_wire(folder: Path) -> None:
    """Bytes of every message, and what they say."""
    wire: dict[str, Any] = {group: {} for group in ("messages", "questions", "answers", "errors", "poses")}
    for name, (topic, message, options) in samples.messages().items():
        parts = encode(message, CodecOptions(**options))
        decoded: Any = decode(parts)
        said, more = golden.plain(decoded), {}
        if "jpeg" in name:
            del said["rgb"]["digest"]
            more = {"pixels": b64encode(decoded.rgb.tobytes()).decode()}
        _keep(wire["messages"], name, parts, said, "jpeg" not in name, topic=topic, options=options, **more)
    for kind, fields in samples.questions().items():
        parts = encode_request(kind, QUESTIONS[kind].request(**fields))
        _keep(wire["questions"], kind, parts, golden.plain(decode_question(parts)), True, kind=kind)
    for kind, answer in samples.answers().items():
        parts = encode_answer(kind, samples.STATE, answer)
        _keep(
            wire["answers"],
            kind,
            parts,
            golden.plain(decode_answer(kind, QUESTIONS[kind].answer, parts)),
            True,
            kind=kind,
        )
    for name in ("MapError", "LabelError", "CodecError", "ShapeError", "PoseError", "WeightsError"):
        parts = encode_error(getattr(errors, name)("the box is empty"))
        try:
            decode_answer("at", QUESTIONS["at"].answer, parts)
        except SemanticMapperError as error:
            wire["errors"][name] = {"parts": _texts(parts), "raises": type(error).__name__}
    for name, parts in samples.pose_messages().items():
        message = decode_pose(parts)
        said = {**golden.meaning(message), "matrix": golden.plain(message.matrix)}
        _keep(wire["poses"], name, parts, said, name == "msgpack")
    wire["topics"] = {
        name: {"queue": t.queue, "latched": t.latched, "logged": t.logged, "closes": t.closes}
        for name, t in TOPICS.items()
    }
    golden.write("wire", wire)


def _keep(entries: dict[str, Any], name: str, parts: list[bytes], said: Any, exact: bool, **more: Any) -> None:
    entries[name] = {"parts": _texts(parts), "says": said, "exact": exact, **more}


def _texts(parts: list[bytes]) -> list[str]:
    return [b64encode(part).decode() for part in parts]


def record_map(folder: Path) -> None:
    """Numbers, summary and surface of the room."""
    run = runs.replay_room(folder)
    points, header, _ = runs.read_ply(run / "map.ply")
    runs.save_points(POINTS, points)
    summary = runs.summary_of(run)
    values = {"numbers": runs.numbers_of(run), "ply_header": header, "summary": golden.form(summary)}
    golden.write("map", {**values, "files": sorted(p.name for p in run.iterdir())})


def record_kitchen(folder: Path) -> None:
    """Numbers of a real recording."""
    shared = Path(os.environ.get("SEMANTIC_MAPPER_SHARED_DATA", SHARED))
    run = runs.replay_kitchen(shared / "redkitchen", folder)
    weights = golden.digest(default_checkpoint_path().read_bytes())
    golden.write("kitchen", {"numbers": runs.numbers_of(run), "weights": weights})


def make_files(folder: Path) -> None:
    """Maps of today; those that are there stay."""
    if not MAP.exists():
        replays = LogReplays(FOLDER, lambda name: folder / name)
        made = replays(LOG, weights=WEIGHTS, config=golden.STORED_SETTINGS, max_frames=golden.STORED_FRAMES)
        made.store(STORED)
    if not MAP_COARSE.exists():
        config = folder / "coarse.toml"
        config.write_text("[render]\nscale = 0.5\n[voxel_map]\nvoxel_size_m = 0.12\nunknown_below = 0.0\n")
        out = folder / "coarse"
        ran = api.run_here("map", LOG, "--weights", WEIGHTS, "--config", config, "--out", out, "--max-frames", "2")
        assert ran.code == 0, ran.stderr
        shutil.copyfile(out / "map.npz", MAP_COARSE)


# Modules whose ``observe`` says what is held.
OBSERVED = ("files", "log", "weights", "answers", "exporters", "command_line", "python")
MADE: dict[str, Callable[[Path], None]] = {"wire": record_wire, "map": record_map, "kitchen": record_kitchen}
GROUPS = (*MADE, *OBSERVED)


def main() -> None:
    """Record."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("group", nargs="*", choices=[*GROUPS, []], help="by default all")
    wanted = parser.parse_args().group or GROUPS
    STORED.mkdir(parents=True, exist_ok=True)
    for name in wanted:
        with tempfile.TemporaryDirectory(prefix="contract-") as folder, patch.dict(os.environ):
            if name in MADE:
                MADE[name](Path(folder))
                continue
            if name == "files":
                make_files(Path(folder))
            golden.write(name, importlib.import_module(f"tests.contract.test_{name}").observe(Path(folder)))
        print(f"{name} recorded")  # noqa: T201 - a script


if __name__ == "__main__":
    main()
