"""Depth from posed pictures: multi-view stereo for cameras without a depth sensor."""

from semantic_mapper.config import DepthFromMotionConfig
from semantic_mapper.depth_from_motion.estimate import estimate_depth
from semantic_mapper.depth_from_motion.sources import choose_sources
from semantic_mapper.depth_from_motion.stream import DepthFromMotion
from semantic_mapper.depth_from_motion.views import DepthEstimate, PreparedView, prepare_view

__all__ = [
    "DepthEstimate",
    "DepthFromMotion",
    "DepthFromMotionConfig",
    "PreparedView",
    "choose_sources",
    "estimate_depth",
    "prepare_view",
]
