"""One room by one field, under each protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import torch

from research.suites.baselines import baseline_predictions
from research.suites.config import (
    SPACINGS,
    SuiteConfig,
    check_suite,
    fit_config,
    settings_digest,
)
from research.suites.predict import predict_view
from research.suites.records import CurvePoint, RoomRecord, Rows
from research.suites.rooms import BenchmarkRoom, as_given
from research.suites.scene_box import scene_config
from research.suites.scoring import (
    Answer,
    as_rows,
    image_record,
    room_agreement,
    room_calibration,
    room_confusion,
    room_interior,
    room_rows,
)
from research.suites.views import Sources, choose_as_mapper, choose_covering, choose_sources
from semantic_mapper.errors import ConfigError
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.fields.checkpoint import adapt_model
from semantic_mapper.fields.learned import LearnedField, build_field
from semantic_mapper.fields.scene.irt import IRT
from semantic_mapper.labels import LabelSet
from semantic_mapper.training.baselines import WarpBaseline
from semantic_mapper.training.finetune import finetune
from semantic_mapper.training.fit import FitProgress
from semantic_mapper.training.select import candidate_from_frame, choose_keyframes
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import SourceViews


@dataclass(frozen=True, slots=True, eq=False)
class RoomResult:
    """A room's record, and the query views behind it."""

    record: RoomRecord
    answers: dict[int, Answer]


@dataclass(frozen=True, slots=True)
class Keyframes:
    """Numbers of the frames that a field is fitted to, and that queries are rendered from."""

    labelled: tuple[int, ...]
    unlabelled: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Entry:
    """A field under test.

    Args:
        name: Heads its column.
        digest: Tells its weights from others'; of a kind with random weights, its settings.
        file: That the weights came from; empty = random ones.
    """

    name: str
    digest: str
    field: LearnedField
    file: str = ""


def run_room(
    room: BenchmarkRoom,
    entry: Entry,
    suite: SuiteConfig,
    on_fit: Callable[[float], None] | None = None,
    stopped: Callable[[], object] = bool,
) -> RoomResult | None:
    """One room by one field, as ``suite.protocol`` says; None where it was stopped while it fitted.

    Raises ConfigError: a budget of nothing, or a room with too few frames.

    Args:
        on_fit: Called with the fraction of the fitting that is done.
        stopped: Asked before every step of the fitting; once it says so (anything true), the room is given up.
    """
    if suite.protocol == "generalize":
        field = entry.field.eval()
        return _scored(room, answer_queries(room, field, suite), entry, suite)
    return _fit_and_score(room, entry, suite, on_fit, stopped)


def answer_queries(room: BenchmarkRoom, field: LearnedField, suite: SuiteConfig) -> dict[int, Answer]:
    """Render all query views from source views without labels, chosen as ``suite.sources`` says."""
    answers: dict[int, Answer] = {}
    for q in room.queries:
        pool = [n for n in range(len(room.frames)) if n != q]
        count = max(1, min(_source_count(field, suite), len(pool)))
        current, depth_m = room.current[q], room.truth[q].depth_m
        if suite.sources == "cover":
            sources = choose_as_mapper(room.frames[:q], current, depth_m, count)
        else:
            candidates, spacing = [room.frames[n] for n in pool], SPACINGS[suite.sources]
            sources = choose_sources(current.T_world_camera, depth_m, candidates, count, spacing, current.intrinsics)
        answers[q] = _answer(room, field, suite, q, pool, sources)
    return answers


def answer_from_keyframes(
    room: BenchmarkRoom, field: LearnedField, suite: SuiteConfig, keyframes: Keyframes
) -> dict[int, Answer]:
    """Render all query views from the keyframes, whatever their distance: they are all that there is."""
    pool = [*keyframes.labelled, *keyframes.unlabelled]
    labelled = keyframes.labelled if suite.scene.labelled_sources else ()
    candidates, brings = [room.frames[n] for n in pool], [n in labelled for n in pool]
    answers: dict[int, Answer] = {}
    for q in room.queries:
        pose, depth_m = room.current[q].T_world_camera, room.truth[q].depth_m
        sources = choose_covering(pose, depth_m, candidates, brings, max(1, _source_count(field, suite)))
        answers[q] = _answer(room, field, suite, q, pool, sources, labelled)
    return answers


def choose_fitted(room: BenchmarkRoom, suite: SuiteConfig) -> Keyframes:
    """The frames that a field is fitted to: what shows most of the room, none of it near a query view.

    Raises ConfigError: too few frames are left.
    """
    guard = suite.scene.guard
    free = [n for n in range(len(room.frames)) if all(abs(n - q) > guard for q in room.queries)]
    if len(free) < max(2, suite.scene.keyframes):
        raise ConfigError(
            f"{suite.scene.keyframes} keyframes are requested; {len(free)} frames of the room are no query view and "
            f"not within {guard} frames of one, and 2 are the least"
        )
    labelled = _most_telling(room, free, suite.scene.keyframes, suite.seed)
    rest = [n for n in free if n not in labelled]
    return Keyframes(tuple(labelled), tuple(_most_telling(room, rest, suite.scene.unlabelled, suite.seed)))


def _most_telling(room: BenchmarkRoom, numbers: Sequence[int], count: int, seed: int) -> list[int]:
    candidates = [candidate_from_frame(room.frames[n]) for n in numbers]
    return [numbers[i] for i in choose_keyframes(candidates, count, seed)] if candidates else []


def _source_count(field: LearnedField, suite: SuiteConfig) -> int:
    """Source views of a query besides the query's own image."""
    return suite.views - (1 if _shows_own(field, suite) else 0)


def _shows_own(field: LearnedField, suite: SuiteConfig) -> bool:
    """Whether the query's own image is a source view."""
    return field.needs_own_view or isinstance(field, IRT) or (suite.protocol == "generalize" and suite.own_image)


def _answer(
    room: BenchmarkRoom,
    field: LearnedField,
    suite: SuiteConfig,
    query: int,
    pool: Sequence[int],
    sources: Sources,
    labelled: Sequence[int] = (),
) -> Answer:
    """Render a query view from ``sources``, positions in ``pool``; frames of ``labelled`` bring their labels."""
    frames = room.frames
    chosen = [pool[i] for i in sources.numbers][: _source_count(field, suite)]
    given = [as_given(room.given[n], depth=True, label=n in labelled) for n in chosen]
    asked = room.asked(query)
    own = _shows_own(field, suite)
    # The own image comes last, where the mapping pipeline has the current view, too.
    prediction = predict_view(field, [*given, asked] if own else given, asked, suite.tier, room.label_set)
    rows = {}
    if suite.protocol == "generalize" and not field.needs_own_view:
        sensed, truth = [as_given(frames[n], depth=True) for n in chosen], room.truth[query]
        rows = baseline_predictions(
            field, given, sensed, asked, prediction, truth.exact_depth_m, truth.label, room.label_set, own_image=own
        )
    return Answer(prediction, sources, (*chosen, query) if own else tuple(chosen), room.condition[query], rows)


def _fit_and_score(
    room: BenchmarkRoom,
    entry: Entry,
    suite: SuiteConfig,
    on_fit: Callable[[float], None] | None,
    stopped: Callable[[], object],
) -> RoomResult | None:
    """Fit to the keyframes with growing shares of the budget; the whole budget gives the room's figures."""
    check_suite(suite)
    keyframes = choose_fitted(room, suite)
    frames = [as_given(room.given[n], depth=True, label=True) for n in keyframes.labelled]
    frames += [as_given(room.given[n], depth=True) for n in keyframes.unlabelled]
    views = stack_sources([view_from_frame(frame, room.label_set, suite.tier.width) for frame in frames])
    field = _start(entry, suite, views, room.label_set)
    answers = answer_from_keyframes(room, field.eval(), suite, keyframes)
    curve = [_curve_point(0.0, 0.0, 0, room_confusion(room, answers))]
    device = next(field.parameters()).device
    if suite.scene.seconds > 0:  # what the first step of a process costs more is no part of any budget
        one_step = msgspec.structs.replace(fit_config(suite, 1.0), seconds=0, steps=1, held_out_rays=64)
        finetune(frames, room.label_set, _start(entry, suite, views, room.label_set), one_step)
    spent, whole = 0.0, sum(suite.scene.shares)
    for share in sorted(suite.scene.shares):
        start = _start(entry, suite, views, room.label_set)
        progress = _progress(on_fit, spent, share, whole)
        fitted = finetune(frames, room.label_set, start, fit_config(suite, share), progress, stopped)
        if stopped():
            return None
        answers = answer_from_keyframes(room, fitted.model.to(device).eval(), suite, keyframes)
        recipe = fitted.recipe
        curve.append(_curve_point(share, float(recipe["seconds"]), int(recipe["steps"]), room_confusion(room, answers)))
        spent += share
    return _scored(room, answers, entry, suite, keyframes.labelled, tuple(curve))


def _progress(
    on_fit: Callable[[float], None] | None, spent: float, share: float, whole: float
) -> Callable[[FitProgress], None] | None:
    """What one of the runs of the curve tells of itself, as a share of all of them."""
    return None if on_fit is None else lambda p: on_fit((spent + p.fraction * share) / whole)


def _start(entry: Entry, suite: SuiteConfig, views: SourceViews, label_set: LabelSet) -> LearnedField:
    """A copy to start from: the weights of a file in the classes of the rooms, or random ones of its shape.

    Args:
        views: Of the scene to be fitted; a kind for one scene alone takes its box from them.
        label_set: Of the scene.
    """
    torch.manual_seed(suite.seed)
    field = entry.field
    if suite.protocol == "finetune" and entry.file:
        return adapt_model(field, label_set)
    config = scene_config(field, views, suite.tier.guided.far_m)
    return build_field(field.kind, config, label_set, field.sampling).to(next(field.parameters()).device)


def _curve_point(share: float, seconds: float, steps: int, confusion: ConfusionMatrix) -> CurvePoint:
    return CurvePoint(share=share, seconds=seconds, steps=steps, confusion=as_rows(confusion))


def _carried_labels(room: BenchmarkRoom, keyframes: Sequence[int]) -> Rows:
    """What the labelled keyframes give by depth alone, without any field: the confusion over all query views."""
    carried = WarpBaseline(room.label_set, [as_given(room.frames[n], depth=True, label=True) for n in keyframes])
    total = ConfusionMatrix(room.label_set)
    for query, truth in room.truth.items():
        total.update(truth.label, carried.predict(as_given(room.current[query], depth=True)), f"query view {query}")
    return as_rows(total)


def _scored(
    room: BenchmarkRoom,
    answers: dict[int, Answer],
    entry: Entry,
    suite: SuiteConfig,
    keyframes: tuple[int, ...] = (),
    curve: tuple[CurvePoint, ...] = (),
) -> RoomResult:
    agreement = room_agreement(room, answers)
    record = RoomRecord(
        settings=settings_digest(suite, "views"),
        weights=entry.digest,
        room=room.seed,
        template=room.template,
        confusion=as_rows(room_confusion(room, answers)),
        images=tuple(image_record(q, answer, room.truth[q], room.label_set) for q, answer in answers.items()),
        calibration=room_calibration(room, answers),
        agreeing=agreement.agreeing,
        compared=agreement.compared,
        interior=as_rows(room_interior(room, answers)),
        rows=room_rows(room, answers),
        keyframes=keyframes,
        curve=curve,
        carried=_carried_labels(room, keyframes) if keyframes and suite.depth == "on" else None,
    )
    return RoomResult(record, answers)
