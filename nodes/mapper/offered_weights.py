"""Files of the weights that a mapper is offered; a finetuner reads them, too, and loads no mapper for that."""

from pathlib import Path

from semantic_mapper.errors import WeightsError
from semantic_mapper.fields.weights import WeightsFile, check_same_shape, encode_alike, load_weights
from semantic_mapper.files import atomic_path
from semantic_mapper.transport.messages import WeightsUpdate, digest_of

FOLDER = "weights"  # next to the map


def file_of_version(folder: Path, number: int) -> Path:
    """Where a mapper keeps weights."""
    return folder / f"{number:06d}.safetensors"


def read_kept(folder: Path, number: int, digest: str, like: WeightsFile) -> WeightsFile:
    """Weights that were kept, whose file has this digest; refused where they cannot replace ``like``."""
    path = file_of_version(folder, number)
    if digest_of(path.read_bytes()) != digest:
        raise WeightsError(f"{path.name}: is another file than the one that was in use")
    return _read(path, like)


def keep_offer(update: WeightsUpdate, folder: Path, like: WeightsFile) -> WeightsFile:
    """Write the file of an offer and read it; it is not kept where the weights cannot replace ``like``."""
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(file_of_version(folder, update.version)) as part:
        part.write_bytes(update.data)
        return _read(part, like)


def _read(path: Path, like: WeightsFile) -> WeightsFile:
    check_same_shape(path, like)
    found = load_weights(path)
    if not encode_alike(found, like):
        raise WeightsError(
            f"{path.name}: its image encoder is another one, so that keyframes would have to be encoded again; "
            "finetune with frozen_encoder_fraction = 1"
        )
    return found
