"""The peers as kinds of fields, which the entry points of this package name."""

from research.peers.config import MVSNeRFConfig, NeuRayConfig, SemanticNeRFConfig
from semantic_mapper.config import PanopticConfig
from semantic_mapper.fields.registry import FieldKind

NEURAY = FieldKind(NeuRayConfig, "research.peers.neuray", "NeuRay")
MVSNERF = FieldKind(MVSNeRFConfig, "research.peers.mvsnerf", "MVSNeRF")
SEMANTIC_NERF = FieldKind(SemanticNeRFConfig, "research.peers.semantic_nerf", "SemanticNeRF")
PANOPTIC_UNIFORM = FieldKind(PanopticConfig, "research.peers.uniform_panoptic", "UniformPanoptic")
