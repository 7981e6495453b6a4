#!/bin/sh
# Guess: a handler that a program has set with signal.signal stays in force when it imports pycolmap.
# Found: the import puts glog's handler in its place, for SIGTERM as for SIGABRT, SIGSEGV and others. On SIGTERM the
#        program prints a C++ stack trace and dies with 143; its handler is not called, and nothing is cleaned up or
#        saved. signal.getsignal goes on naming the lost handler. One that is set after the import is called.
# Seen:  pycolmap 4.2.1, Python 3.11, Linux x86-64.
# Who:   services that save their work when systemd, Docker or a launcher stops them by SIGTERM, and that import pycolmap
#        only when it is needed, or by another package.
# What to do: import pycolmap before signal.signal, or set the handler once more after the import.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/service.py" <<'PY'
import os
import signal
import sys
import time


def save(signum, frame):
    print("saved", end=" ", flush=True)
    sys.exit(7)


if sys.argv[1] == "after":
    import pycolmap
signal.signal(signal.SIGTERM, save)
if sys.argv[1] == "before":
    import pycolmap
assert signal.getsignal(signal.SIGTERM) is save
os.kill(os.getpid(), signal.SIGTERM)
time.sleep(5)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q pycolmap==4.2.1 numpy==2.4.6
said() { "$work/env/bin/python" "$work/service.py" "$1" 2>"$work/log" || echo "$?"; }
before=$(said before)
trace=$(grep -c "received by PID" "$work/log")
after=$(said after)
echo "handler set before the import: $before, traces: $trace; after it: $after"
[ "$before" = 143 ] && [ "$trace" = 1 ] && [ "$after" = "saved 7" ]
