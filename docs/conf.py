"""The site of `make docs`: the pages of the repository, where they lie, and what the docstrings say (Sphinx)."""

from __future__ import annotations

from pathlib import Path

from sphinx.application import Sphinx

import semantic_mapper

project = "semantic-mapper"
version = release = semantic_mapper.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
include_patterns = ["*.md", "docs/*.rst", "docs/**.md", "examples/**.md", "research/docs/**.md"]
exclude_patterns = [".*", "build", "dist", "runs", "semantic_mapper"]
root_doc = "README"
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "description"
html_theme = "furo"
html_show_search_summary = False  # a page read from the disk may not load others
html_show_copyright = html_show_sourcelink = html_copy_source = False
html_title = f"semantic-mapper {version}"

# Page -> what the menu shows below it, by captions. Forges show pages as they are, so they do not hold this.
_HOW_TO = [f"docs/{name}" for name in ("recordings", "cameras", "robots", "scenes", "fleet")]
_PROJECT = ["docs/architecture", "docs/decisions/README", "research/docs/experiments", "CONTRIBUTING"]
_REST = sorted({f"docs/{page.stem}" for page in Path(__file__).parent.glob("*.md")} - {*_HOW_TO, *_PROJECT})
MENU = {
    "README": {"How to": _HOW_TO, "Reference": ["docs/python", *_REST, "CHANGELOG"], "The project": _PROJECT},
    "docs/robots": {"Examples": ["examples/robot/README"]},
    "docs/decisions/README": {"Decisions": ["docs/decisions/0*", "research/docs/decisions/0*"]},
    "research/docs/experiments": {"Research": ["research/docs/[!e]*"]},
}


def setup(app: Sphinx) -> None:
    """Add the menu to the pages that head it."""
    app.connect("source-read", _add_menu)


def _add_menu(app: Sphinx, page: str, source: list[str]) -> None:
    for caption, pages in MENU.get(page, {}).items():
        listed = "\n".join(f"/{name}" for name in pages)
        source[0] += f"\n\n```{{toctree}}\n:hidden:\n:glob:\n:caption: {caption}\n\n{listed}\n```\n"
