#!/bin/sh
# Guess: what `ZstdCompressor.compress` returns takes as much memory as it is long: one of 282 bytes, 282.
# Found: it holds the room that incompressible data would have needed. 200 class images of 320 x 240, of 282 bytes each
#        once compressed, take 15 MB; `sys.getsizeof` says 315 bytes, and a memory profile shows no leak, as they are in
#        use. `bytes(result)` copies nothing; `bytes(memoryview(result))` does, and frees it. The streaming interface and
#        zlib give what they say.
# Seen:  python-zstandard 0.25.0, C backend, Python 3.11, Linux x86-64.
# Who:   users who keep compressed frames, depth images or map blocks in memory.
# What to do: keep bytes(memoryview(result)) where it stays for long.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys
import tracemalloc
import zlib

import numpy as np
import zstandard

IMAGES, SHAPE = 200, (240, 320)
label = np.zeros(SHAPE, np.uint8)
label[60:180, 80:240] = 3  # a table on a floor


def held(make):
    """Bytes in use for the results, bytes that they are long, and bytes that Python says."""
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    kept = [make() for _ in range(IMAGES)]
    used = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    return used, sum(map(len, kept)), sum(map(sys.getsizeof, kept))


def streamed():
    packer = zstandard.ZstdCompressor().compressobj()
    return packer.compress(label.tobytes()) + packer.flush()


compressor = zstandard.ZstdCompressor()
ways = {
    "compress": lambda: compressor.compress(label.tobytes()),
    "bytes of it": lambda: bytes(compressor.compress(label.tobytes())),
    "a copy": lambda: bytes(memoryview(compressor.compress(label.tobytes()))),
    "streamed": streamed,
    "zlib": lambda: zlib.compress(label.tobytes()),
}
found = {name: held(make) for name, make in ways.items()}
print(f"zstandard {zstandard.__version__}, {zstandard.backend}; {IMAGES} images of {label.nbytes} bytes")
for name, (used, long, said) in found.items():
    print(f"{name:12} {long:8,} bytes long, sys.getsizeof says {said:8,}, in use {used:12,}")
expected = {"compress": True, "bytes of it": True, "a copy": False, "streamed": False, "zlib": False}
same = all((used > 0.9 * IMAGES * label.nbytes) == expected[name] for name, (used, _, _) in found.items())
print("as stated" if same else "CHANGED")
sys.exit(not same)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q zstandard==0.25.0 numpy==2.4.6
"$work/env/bin/python" "$work/try.py"
