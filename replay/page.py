"""A report as one page of HTML.

Pictures, figures and the map's points are inside the page; it fetches nothing, and its policy forbids it to. What comes
from files and sockets is text in it: escaped, with control characters as escapes.
"""

import base64
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape
from rich.table import Table

from semantic_mapper.errors import ConfigError
from semantic_mapper.evaluation.upright import ceiling_height, upright_rotation
from semantic_mapper.files import write_bytes
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.plain_text import visible, without_secrets
from semantic_mapper.plots import UNKNOWN, class_rows, encode_picture
from semantic_mapper.replay.overview import open_side, point_spacing
from semantic_mapper.types import Float64, UInt8

MAX_VIEW_POINTS = 300_000  # 10 bytes each
_TEMPLATES = Path(__file__).parent / "templates"

Picture = tuple[str, str]  # its source, a ``data:`` URL, and its caption


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a page; what it has stands in this order."""

    heading: str = ""  # none of its own where empty
    notes: Sequence[str] = ()  # paragraphs that the reader must not miss
    view: Mapping[str, Any] | None = None  # what ``point_view`` returns; at most once a page
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()  # those that the console shows
    folded: Mapping[str, str] = field(default_factory=dict)  # texts that a click unfolds, by their heads


def write_page(path: Path, title: str, sections: Sequence[Section]) -> None:
    """Write a page, whole or not at all; empty sections are left out. Raises ConfigError: it cannot be written."""
    pages = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: value if isinstance(value, Markup) else _shown(str(value)),
    )
    pages.globals["zip"] = zip
    pages.filters["lines"] = lambda text: Markup(escape(visible(without_secrets(text), keep="\n")))
    script = (_TEMPLATES / "points.js").read_text(encoding="utf-8")
    parts = [s for s in sections if s.notes or s.view or s.pictures or s.tables or s.folded]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    page = pages.get_template("report.html.jinja").render(
        title=title, sections=parts, script=Markup(script), script_digest=digest
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, page.encode())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error


def _shown(text: str) -> str:
    """A text as people see it; pictures stay as they are."""
    return text if text.startswith("data:image/") else visible(without_secrets(text))


def picture(pixels: UInt8, caption: str, *, photo: bool = False) -> Picture:
    """(H, W, 3) RGB; ``photo``: as JPEG, which is smaller where there are no sharp lines."""
    data = _base64(encode_picture(pixels, jpeg=photo))
    return f"data:image/{'jpeg' if photo else 'png'};base64,{data}", caption


def picture_files(*files: tuple[Path, str]) -> Iterator[Picture]:
    """Pictures that were written before, with their captions; those that are not there are left out."""
    for path, caption in files:
        data = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
        if data is not None:
            yield picture(np.asarray(cv2.cvtColor(data, cv2.COLOR_BGR2RGB), np.uint8), caption, photo=True)


def point_view(points: MapPoints, label_set: LabelSet, up: Float64 | None) -> dict[str, Any]:
    """The map for the page's 3D view, N > 0 points of which at most ``MAX_VIEW_POINTS``, drawn at random, are shown:
    ``classes`` as a legend, and ``data`` for ``templates/points.js``.

    The points are turned upright; ``up`` (3,) is the rough up of the world, None = unknown. Positions are uint16
    fractions of their bounds, below a millimetre in a map of 60 m.
    """
    count = min(len(points.xyz), MAX_VIEW_POINTS)
    chosen = np.random.default_rng(0).permutation(len(points.xyz))[:count]
    xyz = points.xyz[chosen].astype(np.float64) @ upright_rotation(points.xyz, up).T
    low, extent = xyz.min(axis=0), np.maximum(np.ptp(xyz, axis=0), 1e-3)
    table = np.full((256, 4), (*UNKNOWN, 255), np.uint8)
    table[list(label_set.ids), :3] = label_set.colors
    ids = dict(zip(label_set.names, label_set.ids, strict=True)) | {"unknown": label_set.ignore_id}
    classes = [
        {"id": ids[name], "name": name, "color": "rgb({},{},{})".format(*color), "share": f"{100 * (part or 0):.1f} %"}
        for name, color, part in class_rows(points.label, label_set)
    ]
    data = {
        "count": count,
        "low": low.tolist(),
        "extent": extent.tolist(),
        "spacing": point_spacing(xyz),
        "ceiling": ceiling_height(xyz),
        "azimuth": open_side(xyz),
        "classes": _base64(table.tobytes()),
        "xyz": _base64(np.round((xyz - low) / extent * 65535).astype("<u2").tobytes()),
        "rgb": _base64(points.rgb[chosen].tobytes()),
        "label": _base64(points.label[chosen].tobytes()),
    }
    return {"classes": classes, "data": data}


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def table_of(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """A plain table."""
    table = Table(*heads)
    for row in rows:
        table.add_row(*row)
    return table
