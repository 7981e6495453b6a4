"""What is kept of a room, as plain data: everything that the figures of a whole run are computed from."""

from __future__ import annotations

import msgspec

from semantic_mapper.config import Config

Rows = tuple[tuple[int, ...], ...]  # a confusion's counts


class DepthRecord(Config, frozen=True):
    """``evaluation.depth_error.DepthErrors`` as data."""

    relative_sum: float
    square_sum: float
    count: int


class ImageRecord(Config, frozen=True):
    """One query view. Figures in 0..1, None where nothing could be compared."""

    frame: int
    sources: tuple[int, ...]  # frame numbers
    baseline_m: float  # mean distance of the source cameras
    seen: float  # share of the query's surface that some source view sees
    miou: float | None
    total_accuracy: float | None
    average_accuracy: float | None
    coverage: float | None
    psnr_db: float | None  # None where the field was shown this very image
    ssim: float | None
    depth: DepthRecord
    condition: str = "clean"  # of the query's own image; see ``rooms.HARD``


class CalibrationRecord(Config, frozen=True):
    """Sums by bin of confidence, over the pixels with truth and prediction."""

    count: tuple[int, ...]
    confidence: tuple[float, ...]
    right: tuple[float, ...]


class BaselineRecord(Config, frozen=True):
    """One of ``baselines.BASELINES`` over the query views of a room."""

    confusion: Rows
    interior: Rows
    calibration: CalibrationRecord


class CurvePoint(Config, frozen=True):
    """Where a share of the budget leads. Fraction 0 is the start."""

    share: float
    seconds: float
    steps: int
    confusion: Rows


class RoomRecord(Config, frozen=True, tag_field="record", tag="views"):
    """The query views of one room by one weights file. Confusions are (L, L + 1) of the suite's classes."""

    settings: str  # digest
    weights: str  # digest
    room: int
    template: str
    confusion: Rows
    images: tuple[ImageRecord, ...]
    calibration: CalibrationRecord
    agreeing: int  # of the pixels of one query view that are found again in its neighbour
    compared: int
    interior: Rows  # of the pixels more than 2 px from a border between labels
    rows: dict[str, BaselineRecord] = msgspec.field(default_factory=dict[str, BaselineRecord])  # by name
    keyframes: tuple[int, ...] = ()  # that the field was fitted to
    curve: tuple[CurvePoint, ...] = ()
    carried: Rows | None = None  # of the keyframes' labels carried over by depth alone


class InstanceRecord(Config, frozen=True):
    """``evaluation.instances.InstanceMatches`` as data; a found instance is as the fields of ``InstanceMatch``."""

    found: tuple[tuple[int, float, float, int, bool], ...]
    truth: tuple[int, ...]


class PanopticRecord(Config, frozen=True):
    """``evaluation.panoptic.PanopticCounts`` as data: ``sums``, (5, L) of the suite's classes."""

    sums: tuple[tuple[float, ...], ...]


class MapRecord(Config, frozen=True, tag_field="record", tag="map"):
    """The fused map of one room by one weights file. Confusions are (L, L + 1) of the suite's classes."""

    settings: str
    weights: str
    room: int
    template: str
    points: int  # of the map's surface
    on_surface: float  # share of them near the true surface
    confusion: Rows  # at the map's own points
    surface_confusion: Rows  # at points of the true surface; holes count as wrong
    view_confusion: Rows  # of the frames' rendered labels
    view_miou: float | None  # mean of the frames' own mIoU
    cast_confusion: Rows  # of the finished map, cast into its frames, where it has an answer
    cast_view_confusion: Rows  # of the frames' rendered labels at those same pixels
    seen_confusion: Rows  # at those of the map's points that some frame sees
    one_frame_confusion: Rows  # at the same points, of one frame each, drawn at random
    calibration: CalibrationRecord  # of the map's points with a label and a truth
    instances: InstanceRecord | None = None  # as queries find them; older records have none
    panoptic: PanopticRecord | None = None  # of the finished map with its instances, cast into its frames; as above


class SceneRecord(Config, frozen=True, tag_field="record", tag="scene"):
    """One scene by one arm of a comparison. Confusions are (L, L + 1) of the suite's classes, by what is scored."""

    settings: str
    weights: str  # name of the arm
    room: int  # seed of the scene
    confusions: dict[str, Rows]
    last_fifth: float | None = None  # mIoU that the last fifth of the arm's steps brought, where looked for
    steps: int | None = None  # of the arm, where they are doubled until its plateau


Record = RoomRecord | MapRecord | SceneRecord
