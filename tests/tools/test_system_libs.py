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


def test_open3d_loads_after_set_up(script: ModuleType) -> None:
    script.FOLDER = Path(sys.prefix) / "syslibs"
    assert script.first_missing() is None


def test_a_libusb_package_without_a_library_is_as_none(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "libusb_package.py").write_text("def get_library_path():\n    return None\n")
    (tmp_path / "open3d").mkdir()
    (tmp_path / "open3d" / "__init__.py").touch()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert script.first_missing() is None  # this open3d links nothing


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
