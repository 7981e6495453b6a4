"""Without the extras, maps are made all the same, and what needs an extra names it."""

from __future__ import annotations

import subprocess
import sys
import textwrap

import pytest

HIDDEN = """
import sys
FLEET = ("ray", "duckdb", "pyarrow", "fsspec", "s3fs", "gcsfs")
for name in ("rerun", "rerun_cli", "tensorboard", "pycolmap", "foxglove", *FLEET):
    sys.modules[name] = None
"""


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("import semantic_mapper.replay.exporters.map_files, semantic_mapper.nodes.cli.main; print('fine')", "fine"),
        (
            """
            from semantic_mapper.errors import SemanticMapperError
            try:
                import semantic_mapper.replay.exporters.rerun_log
            except SemanticMapperError as error:
                print(error)
            """,
            "pip install 'semantic-mapper[viewer]'",
        ),
        (
            """
            from pathlib import Path
            from semantic_mapper.errors import SemanticMapperError
            from semantic_mapper.replay.sfm.reconstruct import FilmOptions, import_film
            try:
                import_film(Path("film.mp4"), Path("film.mcap"), FilmOptions(), print)
            except SemanticMapperError as error:
                print(error)
            """,
            "pip install 'semantic-mapper[sfm]'",
        ),
        *(
            (
                f"""
                from semantic_mapper.errors import SemanticMapperError
                try:
                    import semantic_mapper.nodes.{kind}.server
                except SemanticMapperError as error:
                    print(error)
                """,
                f"pip install 'semantic-mapper[{kind}]'",
            )
            for kind in ("foxglove",)
        ),
        *(
            (
                f"""
                from semantic_mapper.nodes.cli.main import app
                app({arguments!r})
                """,
                'pip install "semantic-mapper[fleet]"',
            )
            for arguments in (
                ["fleet", "run", "replay", __file__, "--out", "none"],
                ["fleet", "table", "none"],
            )
        ),
    ],
)
def test_what_an_extra_is_needed_for_names_it(lines: str, expected: str) -> None:
    run = subprocess.run(
        [sys.executable, "-c", HIDDEN + textwrap.dedent(lines)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert expected in run.stdout + run.stderr, run.stderr
