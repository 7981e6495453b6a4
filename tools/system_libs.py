"""Give Open3D the system libraries it links and the machine lacks, without root and without touching the system.

The wheel links libX11, libGL, libEGL and others, which a server or a container often does not have. This script tries
to load Open3D's own library; for each one that the dynamic linker misses it fetches the Debian or Ubuntu package that
holds it (``apt-get download`` with its own list and cache folders, ``dpkg-deb -x``) and puts the one file into
``.venv/syslibs``, from where ``semantic_mapper/mapping/open3d_loader.py`` loads it. Run by ``make setup``.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = Path(sys.prefix) / "syslibs"

# Soname -> packages that hold it, newest release first. Everything that Open3D's library reaches, links of links too.
PACKAGES = {
    "libEGL.so.1": ("libegl1",),
    "libGL.so.1": ("libgl1",),
    "libGLX.so.0": ("libglx0",),
    "libGLdispatch.so.0": ("libglvnd0",),
    "libX11.so.6": ("libx11-6",),
    "libXau.so.6": ("libxau6",),
    "libXdmcp.so.6": ("libxdmcp6",),
    "libbsd.so.0": ("libbsd0",),
    "libcap.so.2": ("libcap2",),
    "libgcc_s.so.1": ("libgcc-s1",),
    "libgomp.so.1": ("libgomp1",),
    "libidn2.so.0": ("libidn2-0",),
    "libmd.so.0": ("libmd0",),
    "libstdc++.so.6": ("libstdc++6",),
    "libudev.so.1": ("libudev1",),
    "libunistring.so.2": ("libunistring2",),
    "libunistring.so.5": ("libunistring5",),
    "libusb-1.0.so.0": ("libusb-1.0-0",),
    "libxcb.so.1": ("libxcb1",),
}

# Run in a child, since a library once loaded stays loaded. LD_LIBRARY_PATH holds FOLDER.
PROBE = """
import ctypes, importlib, importlib.util, pathlib
usb = importlib.util.find_spec("libusb_package") and importlib.import_module("libusb_package").get_library_path()
if usb:  # where it was built from source, it has none
    ctypes.CDLL(str(usb), mode=ctypes.RTLD_GLOBAL)
root = pathlib.Path(importlib.util.find_spec("open3d").origin).parent
for pattern in ("libOpen3D.so*", "pybind*.so", "cpu/pybind*.so"):
    for path in sorted(root.glob(pattern)):
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
"""


def main() -> int:
    """Fetch what is missing; 0 where Open3D's library can be loaded at the end."""
    if not sys.platform.startswith("linux"):
        return 0  # the wheels of other systems bring everything
    fetched: list[str] = []
    with tempfile.TemporaryDirectory(prefix="syslibs-") as scratch:
        while missing := first_missing():
            if missing in fetched or missing not in PACKAGES:
                return fail(f"{missing} cannot be provided: no known package holds it", missing)
            if not shutil.which("apt-get") or not shutil.which("dpkg-deb"):
                return fail("this system has no apt-get and dpkg-deb to fetch it with", missing)
            error = fetch(missing, Path(scratch))
            if error:
                return fail(error, missing)
            fetched.append(missing)
    if fetched:
        print(f"system libraries put into {FOLDER}: {', '.join(fetched)}")
    return 0


def first_missing() -> str | None:
    """Name of the first library that the dynamic linker does not find, None where all are there."""
    paths = [str(FOLDER), *filter(None, [os.environ.get("LD_LIBRARY_PATH")])]
    environment = {**os.environ, "LD_LIBRARY_PATH": ":".join(paths)}
    probe = subprocess.run([sys.executable, "-c", PROBE], env=environment, capture_output=True, text=True, check=False)
    if probe.returncode == 0:
        return None
    found = re.search(r"OSError: (\S+): cannot open shared object file", probe.stderr)
    if found is None:
        raise SystemExit(f"setup: Open3D's library cannot be loaded:\n{probe.stderr}")
    return found.group(1)


def fetch(soname: str, scratch: Path) -> str:
    """Put the file of ``soname`` into FOLDER; returns what went wrong, empty where nothing did."""
    if not (scratch / "lists").exists():
        for name in ("lists/partial", "cache/archives/partial", "deb"):
            (scratch / name).mkdir(parents=True)
        print("fetching system libraries that Open3D needs and this machine lacks ...", flush=True)
        update = apt("update", scratch)
        if update.returncode != 0:
            return f"apt-get update failed: {update.stderr.strip()}"
    reasons: list[str] = []
    for package in PACKAGES[soname]:
        download = apt("download", scratch, package)
        if download.returncode == 0:
            return unpack(soname, package, scratch)
        reasons.append(download.stderr.strip())
    return f"apt-get download failed: {'; '.join(reasons)}"


def apt(verb: str, scratch: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run apt-get on the system's package sources, with lists and cache of our own, so that no root is needed."""
    options = {
        "Dir::State::Lists": scratch / "lists",
        "Dir::Cache": scratch / "cache",
        "Debug::NoLocking": "true",
        "APT::Sandbox::User": "",  # root would hand downloads to a user who cannot write into our folder
        "Acquire::Languages": "none",
        "Acquire::Retries": "3",
    }
    flags = [word for key, value in options.items() for word in ("-o", f"{key}={value}")]
    command = ["apt-get", "-q", *flags, verb, *arguments]
    return subprocess.run(command, cwd=scratch / "deb", capture_output=True, text=True, check=False)


def unpack(soname: str, package: str, scratch: Path) -> str:
    """Copy the one library of ``package`` into FOLDER under its soname; returns what went wrong."""
    archive = next((scratch / "deb").glob(f"{package}_*.deb"))
    tree = scratch / f"{package}.tree"
    unpacked = subprocess.run(["dpkg-deb", "-x", archive, tree], capture_output=True, text=True, check=False)
    if unpacked.returncode != 0:
        return f"{archive.name} cannot be unpacked: {unpacked.stderr.strip()}"
    found = sorted(tree.rglob(soname))
    if not found:
        return f"{archive.name} does not hold {soname}"
    FOLDER.mkdir(exist_ok=True)
    partial = FOLDER / f".{soname}.partial"
    shutil.copyfile(found[0].resolve(), partial)
    partial.rename(FOLDER / soname)
    return ""


def fail(reason: str, soname: str) -> int:
    """Say what is missing and what would fix it."""
    packages = " or ".join(PACKAGES.get(soname, ("the package that holds it",)))
    print(
        f"setup: Open3D needs {soname}, which this machine lacks: {reason}\n"
        f"Install it with the system's package manager (Debian/Ubuntu: {packages}) and run `make setup` again.",
        file=sys.stderr,
    )
    return 1


if __name__ == "__main__":
    sys.exit(main())
