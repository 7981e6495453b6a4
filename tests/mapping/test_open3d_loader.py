from __future__ import annotations

import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]


def run_python(code: str, *path: Path) -> subprocess.CompletedProcess[str]:
    prelude = f"import sys; sys.path[:0] = {[str(p) for p in (*path, REPOSITORY)]!r}\n"
    return subprocess.run([sys.executable, "-I", "-c", prelude + code], capture_output=True, text=True, timeout=100)


def test_missing_system_library_is_named_with_the_mend(tmp_path: Path) -> None:
    package = tmp_path / "open3d"
    package.mkdir()
    message = "libGL.so.1: cannot open shared object file: No such file or directory"
    (package / "__init__.py").write_text(f"raise ImportError({message!r})\n")
    code = (
        "from semantic_mapper.errors import DependencyError\n"
        "from semantic_mapper.mapping.open3d_loader import load_open3d\n"
        "try:\n    load_open3d()\nexcept DependencyError as error:\n    print(error)"
    )
    done = run_python(code, tmp_path)
    assert "libGL.so.1" in done.stdout and "make setup" in done.stdout and "apt-get install" in done.stdout, done.stderr
