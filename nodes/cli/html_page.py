"""A page of HTML in one file, text, tables and pictures inside; no script, and nothing is fetched from anywhere."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape as escape_markup
from pathlib import Path

import cv2
import numpy as np
from rich.table import Table

from semantic_mapper.errors import ConfigError
from semantic_mapper.files import write_bytes
from semantic_mapper.plain_text import visible
from semantic_mapper.types import UInt8

JPEG_QUALITY = 88
_STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1180px; margin: 2em auto; padding: 0 1.2em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #8886; }
table { border-collapse: collapse; margin: .8em 0; } caption { text-align: left; font-weight: 600; padding: .3em 0; }
th, td { padding: .16em .9em .16em 0; text-align: left; vertical-align: top; font-variant-numeric: tabular-nums; }
th { font-weight: 600; } th.right, td.right { text-align: right; } tr.section td { border-top: 1px solid #8886; }
figure { margin: 1em 0; } img { max-width: 100%; height: auto; border-radius: 4px; } figcaption { opacity: .75; }
pre { overflow: auto; padding: .8em; background: #8881; border-radius: 4px; } .note { color: #b45f06; }
"""


class HtmlPage:
    """Collects what is on the page, from its head down.

    Args:
        title: Of the page.
    """

    def __init__(self, title: str) -> None:
        self._title = _escape(title)
        self._parts: list[str] = []

    def heading(self, text: str) -> None:
        """Of a new section."""
        self._parts.append(f"<h2>{_escape(text)}</h2>")

    def text(self, text: str, *, note: bool = False) -> None:
        """A paragraph; ``note``: one that the reader must not miss."""
        kind = ' class="note"' if note else ""
        self._parts.append(f"<p{kind}>{_escape(text)}</p>")

    def table(self, table: Table) -> None:
        """The same table that the console shows; its cells are text."""
        columns = [list(column.cells) for column in table.columns]
        sides = [f' class="{c.justify}"' if c.justify == "right" else "" for c in table.columns]
        heads = [str(column.header) for column in table.columns]
        lines = ["<table>"]
        if table.title:
            lines.append(f"<caption>{_escape(str(table.title))}</caption>")
        if any(heads):
            lines.append(_row("th", heads, sides))
        after_section = False
        for number, row in enumerate(table.rows):
            cells = [str(column[number]) for column in columns]
            lines.append(_row("td", cells, sides, ' class="section"' if after_section else ""))
            after_section = row.end_section
        self._parts.append("\n".join([*lines, "</table>"]))

    def rows(self, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """A plain table."""
        table = Table(*heads)
        for row in rows:
            table.add_row(*row)
        self.table(table)

    def picture(self, picture: UInt8, caption: str, *, photo: bool) -> None:
        """(H, W, 3) RGB; ``photo``: as JPEG, which is smaller where there are no sharp lines."""
        suffix, options = (".jpg", [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]) if photo else (".png", [])
        encoded, data = cv2.imencode(suffix, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)
        assert encoded
        kind = "jpeg" if photo else "png"
        source = f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode('ascii')}"
        alt = _escape(caption)
        self._parts.append(f'<figure><img src="{source}" alt="{alt}"/><figcaption>{alt}</figcaption></figure>')

    def picture_file(self, path: Path, caption: str) -> None:
        """A picture that was written before; one that is not there is left out."""
        if not path.is_file():
            return
        data = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
        if data is not None:
            self.picture(np.asarray(cv2.cvtColor(data, cv2.COLOR_BGR2RGB), np.uint8), caption, photo=True)

    def folded(self, summary: str, text: str) -> None:
        """Text that a click unfolds."""
        inside = _escape(text, keep="\n")
        self._parts.append(f"<details><summary>{_escape(summary)}</summary><pre>{inside}</pre></details>")

    def write(self, path: Path) -> None:
        """Write the page, whole or not at all.

        Raises:
            ConfigError: it cannot be written.
        """
        head = f'<meta charset="utf-8"/><title>{self._title}</title><style>{_STYLE}</style>'
        body = "\n".join([f"<h1>{self._title}</h1>", *self._parts])
        page = f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, page.encode())
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error


def _escape(text: str, keep: str = "") -> str:
    """Text as text: no markup, and nothing that turns the direction of writing."""
    return escape_markup(visible(text, keep), quote=True)


def _row(kind: str, cells: Sequence[str], sides: Sequence[str], attributes: str = "") -> str:
    written = (f"<{kind}{side}>{_escape(cell)}</{kind}>" for cell, side in zip(cells, sides, strict=True))
    return f"<tr{attributes}>{''.join(written)}</tr>"
