"""What a learned refinement has to beat: votes smoothed over neighbouring surface, nothing learned."""

from __future__ import annotations

import torch

from semantic_mapper.fields.nesf import Cells, Nesf, NesfConfig, NesfWeights, smoothed
from semantic_mapper.fields.sparse_conv import cell_levels
from semantic_mapper.labels import LabelSet


class SmoothedVotes(Nesf):
    """Takes the place of the network: each cell answers with the votes round it."""

    def forward(self, cells: Cells) -> torch.Tensor:
        """(M, L + 1): the smoothed log-probabilities, and -1, so that a voxel's own do not count besides."""
        said = smoothed(cells, cell_levels(cells.cells, 1)[0])
        return torch.cat((said, torch.full((len(said), 1), -1.0)), dim=1)


def smoothed_votes(label_set: LabelSet) -> NesfWeights:
    """The baseline, to be handed to ``refine`` in place of weights."""
    return NesfWeights(SmoothedVotes(label_set, NesfConfig(width=1)).eval(), {}, "smoothed")
