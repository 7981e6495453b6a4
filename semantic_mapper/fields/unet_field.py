"""The per-image U-Net as a field: S-Ray's image encoder with a classifier, and nothing that looks across views.

What multi-view fields have to beat. A query ray is answered from the source view whose camera is the query camera, and
from no other; a query whose own image is not among the sources is *unknown* all over. So an evaluation has to put it
there, or to ask ``predict_image`` (the same logits without rays). In training the dense loss on the source views
(``source_logits``) teaches the network in every step.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import torch
from torch import nn
from torch.nn import functional

from semantic_mapper.config import SamplingConfig, UNetFieldConfig
from semantic_mapper.fields.encoder import ImageEncoder
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.views import EncodedViews, check_views, encoded_views, gather, own_view, reproject
from semantic_mapper.fields.volume import field_render
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, RayBatch, SourceViews


class UNetField(LearnedField):
    """Per-image classification behind the ray interface. Depth priors of rays and where these are sampled play no part;
    measured depth of an image does where the encoder sees it."""

    kind = "unet"
    needs_own_view = True
    class_rows = ("classifier.weight", "classifier.bias")

    def __init__(self, config: UNetFieldConfig, label_set: LabelSet, sampling: SamplingConfig | None = None) -> None:
        super().__init__(config, label_set, sampling)
        self.config: UNetFieldConfig = config
        self.encoder = ImageEncoder(config.encoder, config.feature_dim)
        self.classifier = nn.Conv2d(config.feature_dim, len(label_set), 1)

    def encode(self, views: SourceViews) -> EncodedViews:
        """Classify each view by itself; ``feature`` of the result holds the logits (m, L, h, w).
        Raises ShapeError: tensors that do not fit together."""
        check_views(views)
        return encoded_views(views, self._logits(views))

    def source_logits(self, sources: EncodedViews) -> torch.Tensor:
        """Logits (m, L, h, w) of the source images: what ``encode`` made of them."""
        return sources.feature

    def predict_image(self, views: SourceViews) -> torch.Tensor:
        """Logits (m, L, H, W) of m images; what rays through their own pixels render to."""
        size = views.rgb.shape[-2:]
        return functional.interpolate(self._logits(views), size=size, mode="bilinear", align_corners=False)

    def render_samples(
        self, rays: RayBatch, z: torch.Tensor, sources: EncodedViews
    ) -> tuple[FieldRender, torch.Tensor]:
        """Logits and colour of each ray's own pixel. Depth, opacity and weights are 0: the network says nothing of
        where the surface is."""
        index, same = own_view(rays, sources)
        where = reproject(rays, torch.ones_like(z[:, :1]), sources)  # any depth: the ray is one pixel of its own view
        found = gather(sources, where)
        row = torch.arange(len(index), device=index.device)
        known = same & where.valid[index, row, 0]
        render = field_render(
            logits=found.feature[index, row, 0],
            depth_m=torch.zeros_like(z[:, 0]),
            opacity=torch.zeros_like(z[:, 0]),
            rgb=found.rgb[index, row, 0] * known[:, None],
            known=known,
        )
        return render, torch.zeros_like(z)

    def _logits(self, views: SourceViews) -> torch.Tensor:
        return self.classifier(functional.relu(self.encoder(views)))
