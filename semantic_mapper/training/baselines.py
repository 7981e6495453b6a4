"""What S-Ray has to beat with the same labelled keyframes: a per-image U-Net, and labels carried over by depth."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from semantic_mapper.config import Config, UNetFieldConfig
from semantic_mapper.errors import FrameError
from semantic_mapper.fields.device import choose_device, to_device
from semantic_mapper.fields.unet_field import UNetField
from semantic_mapper.geometry import NEAREST_Z_M, invert_pose, nearest_pixels, transform, unproject
from semantic_mapper.imaging import fill_holes, resize_depth
from semantic_mapper.labels import LabelSet
from semantic_mapper.training.fit import Budget, FitProgress, cosine_rate, descend, fit
from semantic_mapper.training.losses import IGNORE
from semantic_mapper.training.views import jitter_colours, mirrored_view, stack_sources, view_from_frame
from semantic_mapper.types import PosedFrame, SourceViews, UInt8

WARP_TOLERANCE = 0.04  # fraction of z by which a keyframe's depth may disagree and still show the same surface
LEARNING_RATE, FINAL_LEARNING_RATE = 1e-3, 5e-5  # along half a cosine
COLOUR_JITTER = 0.2  # as in the fields' own training


class UNetConfig(Config, frozen=True):
    """Budget of the per-image U-Net."""

    seconds: float = 300.0
    steps: int = 0  # this many instead of ``seconds``; 0 = seconds
    width: int = 320
    batch: int = 4
    seed: int = 0


class UNetBaseline:
    """A per-image U-Net from random weights, on the GPU where there is one: a residual encoder of colours with a
    classifier on top.

    What the encoder of the finetuned field says of single images, in the same seconds, is the row "own image alone".
    """

    def __init__(self, label_set: LabelSet, config: UNetConfig) -> None:
        torch.manual_seed(config.seed)
        self.label_set = label_set
        self.config = config
        self.device = choose_device("auto", 0)
        self.net = UNetField(UNetFieldConfig(), label_set).to(self.device)

    def fit(self, frames: Sequence[PosedFrame], on_progress: Callable[[float], None] | None = None) -> int:
        """Train on labelled frames for the budget, with colour jitter and mirrored images; returns the steps done."""
        if not frames:
            raise FrameError("the U-Net baseline needs labelled frames, got none")
        views = [view_from_frame(f, self.label_set, self.config.width) for f in frames]
        generator = torch.Generator().manual_seed(self.config.seed)
        optimiser = torch.optim.AdamW(self.net.parameters(), LEARNING_RATE, weight_decay=1e-4)

        def learn(fraction: float) -> float:
            for group in optimiser.param_groups:
                group["lr"] = cosine_rate(fraction, LEARNING_RATE, FINAL_LEARNING_RATE)
            order = torch.randperm(len(views), generator=generator).tolist()[: self.config.batch]
            batch = [views[i] for i in order]
            if float(torch.rand(1, generator=generator)) < 0.5:
                batch = [mirrored_view(v) for v in batch]
            sources = self.varied(stack_sources(batch), generator)
            channel = torch.stack([v.channel for v in batch])
            with self.net.encoder.batch_statistics():
                logits = self.net.predict_image(to_device(sources, self.device))
            loss = functional.cross_entropy(logits, channel.to(self.device), ignore_index=IGNORE)
            return descend(optimiser, loss)

        def follow(progress: FitProgress) -> None:
            if on_progress is not None:
                on_progress(progress.fraction)

        budget = Budget(0.0 if self.config.steps else self.config.seconds, self.config.steps, on_progress=follow)
        steps = fit(learn, budget)
        self.net.eval()
        return steps

    def varied(self, sources: SourceViews, generator: torch.Generator) -> SourceViews:
        """Images of a step in other light."""
        return jitter_colours(sources, COLOUR_JITTER, generator)

    def predict(self, frame: PosedFrame) -> UInt8:
        """Class ids (H, W) of one image at full size."""
        plain = replace(frame, depth_m=None, depth_sigma_m=None, label=None)
        view = view_from_frame(plain, self.label_set, self.config.width)
        with torch.inference_mode():
            logits = self.net.predict_image(to_device(stack_sources([view]), self.device))
            full = functional.interpolate(logits, size=frame.rgb.shape[:2], mode="bilinear", align_corners=False)
            channel = full[0].argmax(0)
        return self.label_set.to_ids(channel.cpu().numpy())


class WarpBaseline:
    """Labels of the keyframes carried over by depth: no learning, nothing where no keyframe looked."""

    def __init__(self, label_set: LabelSet, frames: Sequence[PosedFrame]) -> None:
        self.label_set = label_set
        self._frames = [f for f in frames if f.label is not None and f.depth_m is not None]
        if not self._frames:
            raise FrameError("carrying labels over needs labelled keyframes with depth, got none")

    def predict(self, frame: PosedFrame) -> UInt8:
        """Class ids (H, W): each pixel takes the label of the keyframe that agrees best with its depth, else ignore."""
        if frame.depth_m is None:
            raise FrameError(f"frame seq={frame.seq} has no depth to carry labels over with")
        depth = fill_holes(resize_depth(frame, frame.intrinsics))
        points = transform(frame.T_world_camera, unproject(depth, frame.intrinsics).reshape(-1, 3))
        best = np.full(len(points), WARP_TOLERANCE)
        label = np.full(len(points), self.label_set.ignore_id, np.uint8)
        for keyframe in self._frames:
            error, found = self._look_up(keyframe, points)
            better = (error < best) & (found != self.label_set.ignore_id)
            best[better], label[better] = error[better], found[better]
        self.label_set.to_channels(label, f"frame seq={frame.seq}")
        return label.reshape(frame.depth_m.shape)

    def _look_up(self, keyframe: PosedFrame, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], UInt8]:
        assert keyframe.label is not None
        k = keyframe.intrinsics
        p = transform(invert_pose(keyframe.T_world_camera), points)
        inside, row, column = nearest_pixels(p, k)
        measured = resize_depth(keyframe, k)[row, column]
        z = np.maximum(p[:, 2], NEAREST_Z_M)
        error = np.where(inside & (measured > 0), np.abs(measured - z) / z, np.inf)
        return error, keyframe.label[row, column]
