"""Every import of the project that the contract tests make. A module that moves is corrected here, and nowhere else.

The tests speak to what users have: the command, files, sockets, and the Python names of the README and how-tos. What
they need beyond these (the codec, the table of commands, the structs of the settings) has a name of its own here.
"""

from __future__ import annotations

import importlib
import io
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import msgspec
import typer.main
from typer.testing import CliRunner

import semantic_mapper.drivers.oak.config
import semantic_mapper.drivers.opencv.config
import semantic_mapper.drivers.poses.config
import semantic_mapper.drivers.realsense.config
import semantic_mapper.drivers.stereo.config
import semantic_mapper.drivers.v4l2.config
from semantic_mapper.client import MapClient
from semantic_mapper.config import MapperConfig, SRayConfig, convert_config, load_config
from semantic_mapper.drivers.calibration import CalibrationFile, load_calibration, load_mount
from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.fields.checkpoint import Checkpoint, default_checkpoint_path, load_checkpoint, save_checkpoint
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import ROOMS, LabelSet
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.mapping.odometry_sessions import CameraPose
from semantic_mapper.mapping.storage.changes import BlockChanges
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.calibration.report import CalibrationSettings
from semantic_mapper.nodes.cli import main as cli
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.finetuner.keyframe_store import LearningStore, Progress
from semantic_mapper.nodes.launcher.launch_file import LaunchFile, NodeEntry, load_launch
from semantic_mapper.nodes.mapper.query_service import QueryService
from semantic_mapper.nodes.options import (
    CameraOptions,
    FinetunerOptions,
    FoxgloveOptions,
    LiveCamera,
    MapperOptions,
    RecorderOptions,
)
from semantic_mapper.queries import questions
from semantic_mapper.queries.instances import Instance, OrientedBox
from semantic_mapper.queries.nearest import NearestSurface, PointAnswers
from semantic_mapper.queries.occupancy import DistanceField
from semantic_mapper.queries.questions import Correction, InstanceArrays, MapInfo, Weights, WeightsEntry
from semantic_mapper.queries.rays import RayHits
from semantic_mapper.replay.compare import Tolerances
from semantic_mapper.replay.corrected_poses import read_corrections
from semantic_mapper.replay.importers.base import RenameConfig
from semantic_mapper.replay.log.format import LogReader, LogWriter
from semantic_mapper.testing import LogReplays
from semantic_mapper.training.config import FinetuneConfig, OnlineConfig
from semantic_mapper.training.finetune import finetune
from semantic_mapper.training.keyframe_pool import Kept, KeyframePool
from semantic_mapper.transport import codec, pose_message, query_messages
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.keys import load_keys
from semantic_mapper.transport.messages import (
    TOPICS,
    EndOfStream,
    FrameRefused,
    LabelledKeyframe,
    LabelSetForm,
    Status,
    StreamInfo,
    WeightsInUse,
    WeightsUpdate,
)
from semantic_mapper.types import CameraIntrinsics, MapUpdate, PosedFrame

__all__ = [
    "COMMAND",
    "ROOMS",
    "TOPICS",
    "BlockChanges",
    "CameraIntrinsics",
    "CameraPose",
    "Checkpoint",
    "CodecOptions",
    "Correction",
    "DistanceField",
    "EndOfStream",
    "FinetuneConfig",
    "FrameRefused",
    "Instance",
    "InstanceArrays",
    "Kept",
    "KeyframePool",
    "LabelSet",
    "LabelledKeyframe",
    "LearningStore",
    "LogReader",
    "LogReplays",
    "LogWriter",
    "MapInfo",
    "MapPoints",
    "MapState",
    "MapUpdate",
    "MapperConfig",
    "NearestSurface",
    "OnlineConfig",
    "OrientedBox",
    "PointAnswers",
    "PosedFrame",
    "RayHits",
    "SRay",
    "SRayConfig",
    "SemanticMapperError",
    "Status",
    "StreamInfo",
    "Tolerances",
    "VoxelMap",
    "Weights",
    "WeightsEntry",
    "WeightsInUse",
    "WeightsUpdate",
    "convert_config",
    "default_checkpoint_path",
    "finetune",
    "label_set_header",
    "load_calibration",
    "load_checkpoint",
    "load_config",
    "load_keys",
    "load_launch",
    "load_mount",
    "read_corrections",
    "save_checkpoint",
]

REPOSITORY = Path(__file__).resolve().parents[2]
LAUNCH = REPOSITORY / "launch"
CLASS_FILES = REPOSITORY / "replay" / "importers" / "classes"
COMMAND = Path(sys.executable).parent / "semantic-mapper"
TIMEOUT_S = 300.0  # kernels may have to be compiled, on a busy machine


@dataclass(frozen=True)
class Ran:
    """A command that has come to its end; ``stdout`` holds results alone, ``stderr`` all that click and logs said."""

    code: int
    stdout: str
    stderr: str


def run_here(*arguments: str | Path) -> Ran:
    """The command in this process."""
    stdout = io.StringIO()
    with patch.object(Output, "guarded", lambda: Output(stdout)):
        done = CliRunner().invoke(cli.app, [str(a) for a in arguments])
    return Ran(done.exit_code, stdout.getvalue(), done.output)


def run_command(*arguments: str | Path) -> Ran:
    """The installed command, in a process of its own."""
    done = subprocess.run(
        [str(COMMAND), *map(str, arguments)], capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    return Ran(done.returncode, done.stdout, done.stderr)


def command_tree() -> Any:
    """The click command that holds all verbs."""
    return typer.main.get_command(cli.app)


def verb_of(name: str) -> Any:
    """The click command of a verb."""
    return command_tree().get_command(None, name)


# Answers.


@contextmanager
def short_folder() -> Iterator[Path]:
    """A folder for sockets, whose paths are short."""
    with tempfile.TemporaryDirectory(prefix="sm-") as folder:
        yield Path(folder)


@contextmanager
def serving(path: Path, endpoint: str) -> Iterator[MapClient]:
    """Ask a saved map through a socket."""
    stop = threading.Event()
    with QueryService(endpoint, VoxelMap.load(path)) as service:

        def follow() -> None:
            while not stop.wait(0.002):
                service.follow()

        mapper = threading.Thread(target=follow)
        mapper.start()
        try:
            with MapClient(endpoint) as client:
                yield client
        finally:
            stop.set()
            mapper.join()


# Wire.

decode_message = codec.decode
encode_message: Mapping[str, Callable[..., list[bytes]]] = dict.fromkeys(TOPICS, codec.encode)
TAKES_OPTIONS = ("frame", "keyframe", "map")  # their encoders know how to pack images
decode_pose, encode_pose = pose_message.decode_pose, pose_message.encode_pose
label_set_header = LabelSetForm.of


QUESTIONS, MapState, decode_question = questions.QUESTIONS, query_messages.MapState, questions.decode_question


def encode_question(kind: str, request: Any) -> list[bytes]:
    """Parts of a question."""
    return query_messages.encode_request(kind, request)


def decode_answer(kind: str, parts: Sequence[bytes]) -> tuple[Any, Any]:
    """What it is about, and the answer; raises what the other side has answered in place of these."""
    return query_messages.decode_answer(kind, QUESTIONS[kind].answer, parts)


def encode_answer(kind: str, state: Any, answer: Any) -> list[bytes]:
    """Parts of an answer."""
    return query_messages.encode_answer(kind, state, answer)


encode_error = query_messages.encode_error


def keep_learning(store: LearningStore, kept: Sequence[Kept]) -> None:
    """Write keyframes of a finetuner that is in the midst of a round."""
    store.keep(kept, Progress(rolled_back=1, failures=2, learning=True))


# Settings: each table that a TOML file of users may hold, and what has to be given in it.

_CAMERA = {"kind": "v4l2", "poses": {"kind": "fixed"}}
_NODE = {"name": "a", "kind": "camera"}
SETTINGS: dict[str, tuple[type[msgspec.Struct], dict[str, Any]]] = {
    "launch": (LaunchFile, {"node": [_NODE]}),
    "launch.node": (NodeEntry, _NODE),
    "launch.camera": (CameraOptions, {"log": "a.mcap"}),
    "launch.camera.camera": (LiveCamera, _CAMERA),
    "launch.mapper": (MapperOptions, {"out": "a"}),
    "launch.recorder": (RecorderOptions, {"out": "a"}),
    "launch.finetuner": (FinetunerOptions, {}),
    "launch.foxglove": (FoxgloveOptions, {}),
    "camera.v4l2": (semantic_mapper.drivers.v4l2.config.Config, {}),
    "camera.opencv": (semantic_mapper.drivers.opencv.config.Config, {"source": "a.mp4"}),
    "camera.stereo": (semantic_mapper.drivers.stereo.config.Config, {}),
    "camera.realsense": (semantic_mapper.drivers.realsense.config.Config, {}),
    "camera.oak": (semantic_mapper.drivers.oak.config.Config, {}),
    **{f"poses.{kind}": (struct, {}) for kind, struct in semantic_mapper.drivers.poses.config.KINDS.items()},
    "poses.checks": (semantic_mapper.drivers.poses.config.PoseChecks, {}),
    "mapper": (MapperConfig, {}),
    "online": (OnlineConfig, {}),
    "finetune": (FinetuneConfig, {}),
    "tolerances": (Tolerances, {}),
    "calibrate": (CalibrationSettings, {}),
    "rename": (RenameConfig, {"classes": {"couch": "sofa"}}),
    "calibration": (
        CalibrationFile,
        {"fx": 80.0, "fy": 80.0, "cx": 47.5, "cy": 35.5, "width": 96, "height": 72},
    ),
}


def parse_settings(name: str, values: Mapping[str, Any]) -> Any:
    """Values as they stand in a TOML file -> the settings; an unknown key is a ``ConfigError``."""
    return convert_config(dict(values), SETTINGS[name][0], name)


def launch_nodes(path: Path) -> list[str]:
    """Names of the nodes of a launch file."""
    return [node.name for node in load_config(path, LaunchFile).node]


# Names of then that are called otherwise now: `replay`, `nodes` and `drivers` are no longer top-level modules, because
# they would hide, or be hidden by, a user's own.
_MOVED = {
    ("replay.log", "LogReader"): ("semantic_mapper.replay.log.format", "LogReader"),
    ("replay.log", "LogWriter"): ("semantic_mapper.replay.log.format", "LogWriter"),
    ("replay.session", "load_pipeline"): ("semantic_mapper", "Mapper.load"),
}


def importable(module: str, name: str) -> Any:
    """What ``from module import name`` gives, or what it gave is called now."""
    module, name = _MOVED.get((module, name), (module, name))
    value: Any = importlib.import_module(module)
    for part in name.split("."):
        value = getattr(value, part)
    return value
