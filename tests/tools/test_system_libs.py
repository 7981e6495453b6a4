from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "tools" / "system_libs.py"
OF_THE_LOADER = {"libc.so.6", "libm.so.6", "libpthread.so.0", "libdl.so.2", "librt.so.1", "libtbb.so.12"}  # or shipped

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux wheels lack libraries")


@pytest.fixture
def script(tmp_path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("system_libs", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.FOLDER = tmp_path / "syslibs"
    return module


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Folder ``deb`` with a package that holds a library behind a link, as Debian's do."""
    if not shutil.which("dpkg-deb"):
        pytest.skip("no dpkg-deb on this system")
    tree = tmp_path / "build"
    libraries = tree / "usr" / "lib" / "some-arch"
    libraries.mkdir(parents=True)
    (libraries / "libfoo.so.1.2.3").write_bytes(b"library")
    (libraries / "libfoo.so.1").symlink_to("libfoo.so.1.2.3")
    (tree / "DEBIAN").mkdir()
    (tree / "DEBIAN" / "control").write_text(
        "Package: libfoo1\nVersion: 1.2.3\nArchitecture: all\nMaintainer: nobody <n@example.org>\nDescription: test\n"
    )
    (tmp_path / "deb").mkdir()
    target = tmp_path / "deb" / "libfoo1_1.2.3_all.deb"
    subprocess.run(["dpkg-deb", "--build", "--root-owner-group", tree, target], check=True, capture_output=True)
    return tmp_path


def test_a_library_is_unpacked_under_its_soname(script: ModuleType, package: Path) -> None:
    assert script.unpack("libfoo.so.1", "libfoo1", package) == ""
    assert [p.name for p in script.FOLDER.iterdir()] == ["libfoo.so.1"]
    assert not (script.FOLDER / "libfoo.so.1").is_symlink()
    assert (script.FOLDER / "libfoo.so.1").read_bytes() == b"library"


def test_open3d_loads_after_set_up(script: ModuleType) -> None:
    script.FOLDER = Path(sys.prefix) / "syslibs"
    assert script.first_missing() is None


def test_every_library_that_open3d_reaches_has_a_known_package(script: ModuleType) -> None:
    if not shutil.which("ldd"):
        pytest.skip("no ldd on this system")
    spec = importlib.util.find_spec("open3d")
    assert spec is not None and spec.origin is not None
    binary = sorted(Path(spec.origin).parent.rglob("pybind*.so"))[0]
    listing = subprocess.run(["ldd", binary], capture_output=True, text=True, check=True).stdout
    names = {line.split()[0] for line in listing.splitlines() if line.split()[0].startswith("lib")}
    unknown = {n for n in names if n not in script.PACKAGES and not n.startswith("libOpen3D")} - OF_THE_LOADER
    assert not unknown
