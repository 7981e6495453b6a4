#!/bin/sh
# Guess: rosbags either converts an array of another type than the message's, or refuses it.
# Found: an array with items of the same size is taken as it lies in memory. A camera matrix of integers, as numpy makes
#        of [600, 0, 320, ...], is stored as if its bits were float64: fx 600 becomes 2.96e-321, with no error or
#        warning. The same matrix as float32 or as a list is refused. ROS 1 and ROS 2 alike.
# Seen:  rosbags 0.11.9, Python 3.11, Linux x86-64.
# Who:   users who write bags with camera matrices or rotations of whole numbers (np.eye(3, dtype=int)).
# What to do: np.asarray(matrix, np.float64) on every array of a message.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys

import numpy as np
from rosbags.typesys import Stores, get_typestore

K = [600, 0, 320, 0, 600, 240, 0, 0, 1]
wrong = False
for store in (Stores.ROS2_HUMBLE, Stores.ROS1_NOETIC):
    types = get_typestore(store)
    first = store == Stores.ROS1_NOETIC
    of = types.types
    stamp = of["builtin_interfaces/msg/Time"](1, 2)
    header = of["std_msgs/msg/Header"](*((0,) if first else ()), stamp, "camera")
    window = of["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    info = of["sensor_msgs/msg/CameraInfo"]
    floats = np.zeros(5), np.eye(3).ravel(), np.zeros(12)

    def stored(matrix):
        """fx after writing and reading, or the error."""
        message = info(header, 480, 640, "plumb_bob", floats[0], matrix, floats[1], floats[2], 0, 0, window)
        try:
            raw = (types.serialize_ros1 if first else types.serialize_cdr)(message, info.__msgtype__)
        except Exception as error:  # whatever it refuses with
            return type(error).__name__
        read = (types.deserialize_ros1 if first else types.deserialize_cdr)(raw, info.__msgtype__)
        return float((read.K if first else read.k)[0])

    found = {
        "float64": stored(np.array(K, np.float64)),
        "int64": stored(np.array(K)),
        "float32": stored(np.array(K, np.float32)),
        "list": stored(K),
    }
    print(store.name, found)
    refused = isinstance(found["float32"], str) and isinstance(found["list"], str)
    wrong |= not (found["float64"] == 600 and refused and found["int64"] != 0 and abs(found["int64"]) < 1e-300)
sys.exit(wrong)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q rosbags==0.11.9 numpy==2.4.6
"$work/env/bin/python" "$work/try.py"
