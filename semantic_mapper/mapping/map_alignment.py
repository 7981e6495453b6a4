"""Where one map lies in another: the places of one are looked for in the other."""

from dataclasses import dataclass

import numpy as np

from semantic_mapper.errors import MapError
from semantic_mapper.geometry import project
from semantic_mapper.localization.features import Features
from semantic_mapper.localization.places import Place
from semantic_mapper.localization.relocalizer import (
    NotFound,
    Relocalized,
    Relocalizer,
    Sighting,
    agreed,
    agreeing_with,
    find_consensus,
    sighting,
)
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.map_types import require_same_scale
from semantic_mapper.mapping.merge import check_fit
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import CameraIntrinsics, Float64

LOOKED_FOR = 60  # places, at most
SURE = 0.7  # confidence from which on a class counts
_NEAR_M = (0.06, 0.03)  # of two surfaces that are taken for one, at first and then
_POINTS = 300_000  # of the other map, at most
_ROUNDS = 50
_VIEW = CameraIntrinsics(262.5, 262.5, 159.5, 119.5, 320, 240)

_log = get_logger(__name__)


class AlignmentError(MapError):
    """It is not known where one map lies in another."""


@dataclass(frozen=True, slots=True, eq=False)
class MapAlignment:
    """Where another map lies."""

    T_map_other: Float64  # (4, 4) float64
    agreeing: int  # places of the other map that say so
    looked_for: int  # of so many


def find_alignment(voxel_map: VoxelMap, other: VoxelMap) -> MapAlignment:
    """Where another map lies in this one.

    ``MapError`` says why: the maps do not fit each other, or ``AlignmentError``."""
    check_fit(voxel_map.config, voxel_map.label_set, other.config, other.label_set)
    require_same_scale(voxel_map.scale_known, other.scale_known, "merge")
    for one, which in ((voxel_map, "first"), (other, "second")):
        if not len(one.places):
            raise AlignmentError(
                f"where the maps lie cannot be found: the {which} one has nothing to find itself by (made without "
                "depth, or with keyframes.save_places = false)"
            )
    finder = Relocalizer(voxel_map.places.places, voxel_map, voxel_map.label_set.ignore_id)
    chosen = other.places.places[:: max(1, -(-len(other.places) // LOOKED_FOR))]
    looks = [(place, _find(finder, other, place)) for place in chosen]
    seen = [sighting(f.T_map_camera, p.T_world_camera) for p, f in looks if not isinstance(f, NotFound)]
    consensus = find_consensus(seen)
    if consensus.refusal:
        refused = ", ".join(sorted({found.reason for _, found in looks if isinstance(found, NotFound)}))
        raise AlignmentError(
            f"where the maps lie cannot be found: of {len(chosen)} places of the second {len(seen)} were found in the "
            f"first ({refused or 'none was refused'}), and {consensus.refusal}"
        )
    T = agreed(consensus.agreeing)
    refined = _refine(voxel_map, other, T)
    kept = [s for s in consensus.agreeing if agreeing_with(Sighting(refined, s.T_world_camera), [s])]
    if 2 * len(kept) >= len(consensus.agreeing):
        T = refined
    else:
        _log.warning("alignment_not_refined", reason="the surfaces fit best where the places do not agree")
    return MapAlignment(T, len(consensus.agreeing), len(chosen))


def _refine(voxel_map: VoxelMap, other: VoxelMap, T_map_other: Float64) -> Float64:
    """Fit the surfaces of two maps: ICP of points to planes, with Tukey's weights.

    Single views leave 0.1 to 0.3 degrees, which is centimetres at the far end of a building."""
    open3d = load_open3d()
    registration = open3d.pipelines.registration
    voxel_m = voxel_map.config.voxel_size_m
    target, source = (
        open3d.geometry.PointCloud(open3d.utility.Vector3dVector(one.points().xyz.astype(np.float64)))
        for one in (voxel_map, other)
    )
    if not len(target.points) or not len(source.points):
        return T_map_other
    target.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(3.5 * voxel_m, 30))
    source = source.uniform_down_sample(-(-len(source.points) // _POINTS))
    criteria = registration.ICPConvergenceCriteria(max_iteration=_ROUNDS)
    for factor, near_m in zip((2, 1), _NEAR_M, strict=True):
        limit_m = max(near_m, factor * voxel_m)
        estimation = registration.TransformationEstimationPointToPlane(registration.TukeyLoss(limit_m))
        fit = registration.registration_icp(source, target, limit_m, T_map_other, estimation, criteria)
        T_map_other = np.array(fit.transformation)
    return T_map_other


def _find(finder: Relocalizer, other: VoxelMap, place: Place) -> Relocalized | NotFound:
    """Look for a place, with what its own map shows from there as picture and depth."""
    view = other.ray_cast(place.T_world_camera, _VIEW)
    points = place.points.astype(np.float64)
    features = Features(project(points, _VIEW), points[:, 2], place.descriptors)
    label = np.where(view.confidence >= SURE, view.label, np.uint8(other.label_set.ignore_id)).astype(np.uint8)
    return finder.find(view.rgb, view.depth_m, _VIEW, lambda: label, features)
