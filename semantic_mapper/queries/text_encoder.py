"""What a text encoder is, such as SigLIP's or MobileCLIP's by ONNX; the package comes with none."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from semantic_mapper.errors import ShapeError
from semantic_mapper.labels import PLAIN_NAMES, LabelSet
from semantic_mapper.types import Float32, Float64

SHARPNESS = 30.0  # softmax of so many times the cosines; models of images and text are trained with 10 to 100


class TextEncoder(Protocol):
    """Texts as vectors that are near to each other where the texts mean the same.

    Example::

        class Siglip:
            def encode(self, texts):
                vectors = self.session.run(None, {"input_ids": self.tokenizer(list(texts))})[0]
                return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    """

    def encode(self, texts: Sequence[str]) -> Float32:
        """(N, D) float32 unit vectors of N texts."""
        ...


def class_weights(text: str, labels: LabelSet, encoder: TextEncoder) -> dict[int, float]:
    """How probable it is that a text means each class, by class id: softmax of cosines. Raises ShapeError: the encoder
    returns something else than unit vectors."""
    texts = [f"a {PLAIN_NAMES.get(name, name)}" for name in (text, *labels.names)]
    vectors: Float64 = np.asarray(encoder.encode(texts), np.float64)
    if vectors.ndim != 2 or len(vectors) != len(texts) or not np.allclose((vectors**2).sum(axis=1), 1, atol=1e-2):
        raise ShapeError(f"text encoder: expected ({len(texts)}, D) unit vectors, got shape {vectors.shape}")
    odds = np.exp(SHARPNESS * (vectors[1:] @ vectors[0] - 1))
    return dict(zip(labels.ids, (odds / odds.sum()).tolist(), strict=True))
