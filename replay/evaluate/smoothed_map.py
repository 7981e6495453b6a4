"""What a learned refinement has to beat: votes smoothed over neighbouring surface, nothing learned."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
import torch

from semantic_mapper.fields.nesf import LOG_SCALE, SHAPE_CHANNELS, Cells, Nesf, NesfConfig, NesfWeights
from semantic_mapper.fields.sparse_conv import OFFSETS, cell_levels
from semantic_mapper.labels import LabelSet

ROUNDS = 2  # of a Gaussian over 3^3 cells, sigma one cell: together 1.4 cells, 6 cm
SAME_SLOPE = 0.3  # cells whose normal . up differs by more belong to another surface
_UP, _VOTES = 2, SHAPE_CHANNELS - 1


class SmoothedVotes(Nesf):
    """Takes the place of the network: each cell answers with the mean of the log-probabilities round it.

    A neighbour counts by a Gaussian of its distance, by its votes, and only where the surface has the same slope.
    """

    def forward(self, cells: Cells) -> torch.Tensor:
        """(M, L + 1): the smoothed log-probabilities, and -1, so that a voxel's own do not count besides."""
        table = cell_levels(cells.cells, 1)[0].neighbours
        distance = torch.from_numpy((OFFSETS**2).sum(axis=1)).float()
        rise, votes, said = cells.x[:, _UP], cells.x[:, _VOTES], cells.x[:, SHAPE_CHANNELS:] / LOG_SCALE
        same = (_padded(rise[:, None])[table][..., 0] - rise[:, None]).abs() < SAME_SLOPE
        kernel = torch.exp(-distance / 2) * same
        for _ in range(ROUNDS):
            weight = kernel * _padded(votes[:, None])[table][..., 0]
            total = weight.sum(dim=1)
            said = torch.einsum("nk,nkc->nc", weight, _padded(said)[table]) / total.clamp_min(1e-6)[:, None]
            votes = total / kernel.sum(dim=1)
        return torch.cat((said, torch.full((len(said), 1), -1.0)), dim=1)


def smoothed_votes(label_set: LabelSet) -> NesfWeights:
    """The baseline, to be handed to ``refine`` in place of weights."""
    return NesfWeights(SmoothedVotes(label_set, NesfConfig(width=1)).eval(), {}, "smoothed")


def _padded(x: torch.Tensor) -> torch.Tensor:
    return torch.cat((x, x.new_zeros(1, x.shape[1])))
