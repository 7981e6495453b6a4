#!/bin/sh
# Guess: `import openvino` starts no process and runs nothing of the program that imports it, which needs no
#        `if __name__ == "__main__"` where it starts no processes itself.
# Found: the import reports itself over the network, from a process that `multiprocessing` starts by its default method.
#        Where that is "forkserver", as of Python 3.14, or "spawn", as programs choose for CUDA, the new process runs the
#        importing script once more from its first line, as "__mp_main__": robots get their commands twice, files are
#        written twice. At each import, with or without a network. Where "openvino_telemetry" cannot be imported, the
#        report is left out and the script runs once; networks compile and run as before.
# Seen:  openvino 2026.4.1, openvino-telemetry 2025.2.0, Python 3.11 with "forkserver" and Python 3.14, Linux x86-64.
# Who:   users of OpenVINO whose script worked with Python 3.13, or by itself and not beside a data loader that spawns.
# What to do: sys.modules["openvino_telemetry"] = None before the import, or `opt_in_out --opt_out` once for each user.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/script.py" <<'PY'
import multiprocessing
import sys
import time

print(__name__, flush=True)
if len(sys.argv) > 1:
    sys.modules["openvino_telemetry"] = None
if __name__ == "__main__" and sys.version_info < (3, 14):
    multiprocessing.set_start_method("forkserver")  # the default of later ones
import numpy as np
import openvino
from openvino import opset13 as ops

if __name__ == "__main__":
    time.sleep(3)
    given = ops.parameter([2], np.float32)
    network = openvino.compile_model(openvino.Model([ops.multiply(given, ops.constant(np.float32(3)))], [given]), "CPU")
    print(*network(np.array([1, 2], np.float32))[0])
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q openvino==2026.4.1 openvino-telemetry==2025.2.0 numpy==2.4.6
export HOME="$work" https_proxy=http://127.0.0.1:9  # nothing is sent from here
unset CI  # where it is set, nothing is sent either
ran=$("$work/env/bin/python" "$work/script.py" | tr '\n' ' ')
without=$("$work/env/bin/python" "$work/script.py" without | tr '\n' ' ')
echo "ran as: $ran; without the package: $without"
[ "$ran" = "__main__ __mp_main__ 3.0 6.0 " ] && [ "$without" = "__main__ 3.0 6.0 " ]
