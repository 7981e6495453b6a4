"""A log as a LeRobotDataset (format v3.0), which ``lerobot``'s own loader reads.

Of each frame: ``observation.images.CAMERA`` (the log's own PNG or JPEG), ``observation.state`` (x y z qx qy qz qw of
the camera in the world, OpenCV axes), ``labels`` (class ids as PNG of one channel; the ignore id where it has none) and
``stamp_ns``. An episode is what was taken in one world. Timestamps are evenly spaced, as the format wants it; the
stamps are the true times. Images lie in the Parquet file, bit for bit, so there are no videos."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from semantic_mapper.errors import DependencyError
from semantic_mapper.replay.exporters.base import ExportFrame, LeftOut, quaternion
from semantic_mapper.replay.label_folder import plain_labels
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float64

AT_ONCE = 64  # frames in memory
CHUNK = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
FIRST = CHUNK.format(chunk_index=0, file_index=0)
STATE, AXES = "observation.state", ("x", "y", "z", "qx", "qy", "qz", "qw")
NUMBERS = ("timestamp", "frame_index", "episode_index", "index", "task_index", "stamp_ns")
TASK = "explore"  # the format wants one


class LeRobotExporter:
    """Writes one folder, which is there, and empty. Raises DependencyError: the extra is not installed."""

    def __init__(self, folder: Path, info: StreamInfo) -> None:
        try:
            import pyarrow.parquet
        except ModuleNotFoundError as error:
            raise DependencyError(
                "lerobot needs the package pyarrow: pip install 'semantic-mapper[lerobot]'"
            ) from error
        self.notices: list[str] = []
        self._pa, self._folder, self._labels = pyarrow, folder, info.label_set
        self._camera = ""
        self._intrinsics: CameraIntrinsics | None = None
        self._world, self._lengths = -1, list[int]()  # of the last frame; frames of each episode
        self._rows: list[dict[str, Any]] = []
        self._stamps: list[int] = []
        self._stats: dict[str, list[Float64]] = {}  # of each frame: mean, mean square, least and most (4, C)
        self._lost = Counter[str]()
        self._fps = 1
        self._writer: Any = None

    def add(self, item: ExportFrame) -> None:
        """Take one frame. Raises LeftOut: it is not later than the one before it, or its camera has changed."""
        frame, labels = item.frame, self._labels
        if self._stamps and frame.stamp_ns <= self._stamps[-1]:
            raise LeftOut("it is not later than the frame before it, which the format needs")
        self._intrinsics, self._camera = self._intrinsics or frame.intrinsics, f"observation.images.{frame.camera_id}"
        if frame.intrinsics != self._intrinsics:
            raise LeftOut("its camera has other intrinsics than the first frame's, and the format has but one")
        if frame.world != self._world:
            self._lengths.append(0)
        state = np.concatenate((frame.T_world_camera[:3, 3], quaternion(frame.T_world_camera)))
        numbers = (0.0, self._lengths[-1], len(self._lengths) - 1, len(self._stamps), 0, frame.stamp_ns)
        row: dict[str, Any] = dict(zip(NUMBERS, numbers, strict=True)) | {STATE: state.tolist()}
        row[self._camera] = {"bytes": item.rgb.data, "path": None}
        self._note(self._camera, frame.rgb / 255)
        self._note(STATE, state[None, None])
        if labels is not None:
            none = np.full(frame.rgb.shape[:2], labels.ignore_id, np.uint8)
            ids = none if frame.label is None else frame.label
            row["labels"] = {"bytes": cv2.imencode(".png", ids)[1].tobytes(), "path": None}
            self._note("labels", ids[..., None] / 255)
        self._world = frame.world
        self._lengths[-1] += 1
        self._stamps.append(frame.stamp_ns)
        self._lost["have no labels: theirs are of the ignore id"] += labels is not None and frame.label is None
        self._lost["have depth, which is left out"] += frame.depth_m is not None
        self._rows.append(row)
        if len(self._rows) == AT_ONCE:
            self._flush()

    def finish(self) -> None:
        """Write the last frames, and what describes all."""
        if not self._stamps:
            return
        self._flush()
        self._writer.close()
        ends = np.cumsum(self._lengths).tolist()
        files = (f"{name}/{kind}_index" for name in ("data", "meta/episodes") for kind in ("chunk", "file"))
        episodes = {"episode_index": range(len(ends)), "tasks": [[TASK]] * len(ends), "length": self._lengths}
        episodes |= {"dataset_from_index": [0, *ends[:-1]], "dataset_to_index": ends}
        self._write_table(f"episodes/{FIRST}", {**episodes, **dict.fromkeys(files, [0] * len(ends))})
        index = dict.fromkeys(("name", "field_name"), "task") | {"pandas_type": "unicode", "numpy_type": "object"}
        about = {"index_columns": ["task"], "column_indexes": [], "columns": [index]}  # the loader reads it by pandas
        self._write_table("tasks.parquet", {"task_index": [0], "task": [TASK]}, {"pandas": json.dumps(about)})
        info = {"codebase_version": "v3.0", "robot_type": None, "fps": self._fps, "features": self._features()}
        info |= {"total_episodes": len(ends), "total_frames": ends[-1], "total_tasks": 1, "chunks_size": 1000}
        info |= {"data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "splits": {"train": f"0:{len(ends)}"}}
        info |= {"data_path": f"data/{CHUNK}", "video_path": None}
        stats = {name: _joined(np.array(rows)) for name, rows in self._stats.items()}
        for name, content in (("info", info), ("stats", stats)):
            (self._folder / f"meta/{name}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
        self.notices += [f"{count} of {ends[-1]} frames {said}" for said, count in (+self._lost).items()]

    def _note(self, name: str, values: Float64) -> None:
        flat = values.reshape(-1, values.shape[-1])
        each = flat.mean(axis=0), (flat**2).mean(axis=0), flat.min(axis=0), flat.max(axis=0)
        self._stats.setdefault(name, []).append(np.stack(each))

    def _features(self) -> dict[str, Any]:
        k, labels = self._intrinsics, self._labels
        assert k is not None
        found: dict[str, Any] = {name: {"dtype": "int64", "shape": [1], "names": None} for name in NUMBERS}
        found["timestamp"]["dtype"] = "float32"
        found[STATE] = {"dtype": "float32", "shape": [len(AXES)], "names": AXES}
        image = {"dtype": "image", "shape": [k.height, k.width, 3], "names": ["height", "width", "channels"]}
        lens = {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "distortion": k.distortion}
        found[self._camera] = {**image, "info": lens}
        if labels is not None:
            found["labels"] = {**image, "shape": [k.height, k.width, 1], "info": plain_labels(labels)}
        return found

    def _flush(self) -> None:
        pa = self._pa
        if self._writer is None:
            steps = np.diff(self._stamps)
            self._fps = max(1, round(1e9 / float(np.median(steps)))) if len(steps) else 1
            kinds = {"image": pa.struct({"bytes": pa.binary(), "path": pa.string()})}
            kinds |= {"float32": pa.float32(), "int64": pa.int64()}
            schema = {name: kinds[f["dtype"]] for name, f in self._features().items()}
            (self._folder / "data" / FIRST).parent.mkdir(parents=True)
            schema[STATE] = pa.list_(pa.float32(), len(AXES))
            self._writer = pa.parquet.ParquetWriter(self._folder / "data" / FIRST, pa.schema(schema))
        for row in self._rows:
            row["timestamp"] = row["frame_index"] / self._fps
        self._writer.write_table(pa.Table.from_pylist(self._rows, self._writer.schema))
        self._rows.clear()

    def _write_table(self, name: str, columns: dict[str, Any], about: dict[str, str] | None = None) -> None:
        path = self._folder / "meta" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self._pa.parquet.write_table(self._pa.table(columns).replace_schema_metadata(about), path)


def _joined(rows: Float64) -> dict[str, Any]:
    """Statistics of frames (N, 4, C): of images with the shape (C, 1, 1)."""
    mean, square = rows[:, :2].mean(axis=0)
    found = {"mean": mean, "std": np.sqrt(np.maximum(square - mean**2, 0))}
    found |= {"min": rows[:, 2].min(axis=0), "max": rows[:, 3].max(axis=0)}
    shape = (-1,) if rows.shape[2] == len(AXES) else (-1, 1, 1)
    return {name: value.reshape(shape).tolist() for name, value in found.items()} | {"count": [len(rows)]}
