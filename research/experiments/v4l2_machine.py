"""A virtual machine with a camera: Debian's own kernel, booted in QEMU, with its virtual camera ``vivid``.

QEMU, busybox and the kernel come as Debian packages (``apt-get download``, some 100 MB, kept in ``.tools/v4l2``);
nothing is installed and no root is needed. The guest sees this machine's files read-only and runs a script with this
project's own Python. Run by ``make test-v4l2``, it runs the checks of the V4L2 driver in ``v4l2_guest.py``.
"""

from __future__ import annotations

import os
import platform
import re
import shlex
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from tools.debian_packages import unpack_packages

ROOT = Path(__file__).resolve().parents[2]
TREE = ROOT / ".tools" / "v4l2"
GUEST = ROOT / "research" / "experiments" / "v4l2_guest.py"
PACKAGES = ("qemu-system-x86", "busybox-static", "linux-image-amd64")
SHARING = ("9p", "9pnet_virtio", "virtio_pci")  # modules that the guest needs to see our files ...
CAMERA = ("vivid",)  # ... and to have a camera ...
NETWORK = ("virtio_net",)  # ... and to be reached by us
ADDRESS = "10.0.2.15"  # of the guest in QEMU's own network
RELAY_PORT = 700  # there
DONE = "guest: exit code "

INIT = """#!/bin/busybox sh
/bin/busybox --install -s /bin
mkdir -p /proc /sys /dev /host
mount -t proc proc /proc; mount -t sysfs sysfs /sys; mount -t devtmpfs dev /dev
for m in {sharing}; do insmod /modules/$m.ko || echo "guest: $m cannot be loaded"; done
mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000,cache=loose,ro host /host || echo "guest: no files"
for m in {camera}; do
  case $m in vivid) insmod /modules/$m.ko n_devs=1 {vivid} ;; *) insmod /modules/$m.ko ;; esac
done
{network}
mkdir -p /dev/shm
for d in proc sys dev; do mount --bind /$d /host/$d; done
export HOME=/dev/shm TMPDIR=/dev/shm PYTHONPATH={root} PYTHONDONTWRITEBYTECODE=1 OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT=2
chroot /host {command}
echo "{done}$?"
poweroff -f
"""
# Nodes of the guest listen on its loopback; what comes from outside is passed on to there, as ``ssh -L`` does. Not
# before they listen: our side tries again at once where a connection is made and lost, at a process of the guest each.
INIT_NETWORK = """ifconfig lo 127.0.0.1 up; ifconfig eth0 {address} up
(until grep -q "0100007F:{port:04X} 00000000:0000 0A" /proc/net/tcp; do sleep 0.5; done
 nc -ll -p {relay} -e /bin/nc 127.0.0.1 {port} 2>/dev/null) &"""


@dataclass(frozen=True, slots=True)
class Guest:
    """What the virtual machine does.

    Args:
        command: Run by this project's Python: a script and its arguments, paths as on this machine.
        vivid: Parameters of the camera's module.
        port: On the guest's loopback, reached from this machine at the same port of its own; 0 = no network.
        timeout_s: After which the machine is killed.
    """

    command: tuple[str, ...]
    vivid: str = "node_types=0x1"
    port: int = 0
    timeout_s: float = 300.0


def main() -> int:
    """0 where all checks in the guest hold."""
    if error := fetch():
        print(f"test-v4l2: skipped: {error}", file=sys.stderr)
        return 0
    began = time.monotonic()
    code = run(Guest((str(GUEST),)))
    print(f"test-v4l2: {'passed' if code == 0 else 'failed'} in {time.monotonic() - began:.0f} s")
    return code


def run(guest: Guest) -> int:
    """Boot the machine and wait for its end; the exit code of its command, 1 where it gave none."""
    with tempfile.TemporaryDirectory(prefix="v4l2-") as scratch:
        initrd = Path(scratch) / "initrd"
        initrd.write_bytes(make_initrd(guest))
        return boot(initrd, guest)


def fetch() -> str:
    """Unpack the packages, and those they depend on, into TREE, once; returns why that cannot be done."""
    if TREE.is_dir():
        return ""
    if platform.machine() != "x86_64":  # the guest runs this machine's Python
        return f"this machine is {platform.machine()}"
    return unpack_packages(PACKAGES, TREE, "QEMU and Debian's kernel")


def make_initrd(guest: Guest) -> bytes:
    """The first files of the guest: busybox, modules, and what it is to do."""
    sharing = with_dependencies(SHARING)
    others = (*CAMERA, *NETWORK) if guest.port else CAMERA
    camera = [m for m in with_dependencies(others) if m not in sharing]
    init = INIT.format(
        sharing=" ".join(sharing),
        camera=" ".join(camera),
        vivid=guest.vivid,
        network=INIT_NETWORK.format(address=ADDRESS, port=guest.port, relay=RELAY_PORT) if guest.port else "",
        root=ROOT,
        command=shlex.join((str(Path(sys.prefix) / "bin" / "python"), *guest.command)),
        done=DONE,
    )
    files = {"init": init.encode(), "bin/busybox": next(TREE.rglob("bin/busybox")).read_bytes()}
    files |= {f"modules/{m}.ko": modules()[m].read_bytes() for m in (*sharing, *camera)}
    return b"".join(
        [cpio_entry(name, b"", 0o040755) for name in ("bin", "modules")]
        + [cpio_entry(name, data, 0o100755) for name, data in files.items()]
        + [cpio_entry("TRAILER!!!", b"", 0)]
    )


def modules() -> dict[str, Path]:
    """Modules of the kernel by the name that others call them by."""
    return {p.stem.replace("-", "_"): p for p in TREE.rglob("lib/modules/*/kernel/**/*.ko")}


def with_dependencies(names: tuple[str, ...]) -> list[str]:
    """Modules and all that they need, in the order of loading."""
    there = modules()
    ordered: list[str] = []

    def add(name: str) -> None:
        if name in ordered or name not in there:  # what is no file is part of the kernel
            return
        needs = re.search(rb"\0depends=([^\0]*)\0", there[name].read_bytes())
        for need in (needs.group(1).decode() if needs else "").split(","):
            add(need.replace("-", "_"))
        ordered.append(name)

    for name in names:
        add(name)
    return ordered


def cpio_entry(name: str, data: bytes, mode: int) -> bytes:
    """One file of an archive as the kernel unpacks it ("newc")."""
    path = name.encode() + b"\0"
    fields = (0, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(path), 0)
    head = b"070701" + b"".join(b"%08X" % value for value in fields) + path
    return head + bytes(-len(head) % 4) + data + bytes(-len(data) % 4)


def boot(initrd: Path, guest: Guest) -> int:
    """Run the guest to its end, showing what it says; its exit code, 1 where it gave none."""
    libraries = ":".join(str(TREE / folder) for folder in ("usr/lib/x86_64-linux-gnu", "lib/x86_64-linux-gnu"))
    network = ("-nic", "none")
    if guest.port:
        forward = f"hostfwd=tcp:127.0.0.1:{guest.port}-{ADDRESS}:{RELAY_PORT}"
        network = ("-netdev", f"user,id=net,restrict=on,{forward}", "-device", "virtio-net-pci,netdev=net,romfile=")
    command = [
        str(TREE / "usr/bin/qemu-system-x86_64"),
        # Emulated, also where there is a /dev/kvm: within a virtual machine that may hang for ever.
        *("-accel", "tcg,thread=multi", "-cpu", "max", "-m", "1500", "-smp", "2", "-nographic", "-no-reboot"),
        *network,
        *("-L", str(TREE / "usr/share/seabios"), "-L", str(TREE / "usr/share/qemu")),
        *("-kernel", str(next(TREE.glob("boot/vmlinuz-*"))), "-initrd", str(initrd)),
        *("-append", "console=ttyS0 quiet panic=-1"),
        *("-virtfs", "local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap"),
    ]
    environment = {**os.environ, "LD_LIBRARY_PATH": libraries}
    code = 1
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True) as vm:
        limit = threading.Timer(guest.timeout_s, vm.kill)
        limit.start()
        assert vm.stdout is not None
        for line in vm.stdout:
            print(line.rstrip(), flush=True)
            if line.startswith(DONE):
                code = int(line.removeprefix(DONE))
        limit.cancel()
    return code


if __name__ == "__main__":
    sys.exit(main())
