#!/bin/sh
# Guess: RealSense's syncer pairs depth and colour of a software device by the difference of their stamps, against the
#        frame rate that the streams declare; at which time the recording began does not matter.
# Found: without a rate from a camera the device invents one: frame number divided by stamp. A steady stream of 30
#        frames a second whose stamps begin at 0 "runs" at 60, 45, 40, 37.5; begun at 1 s, at 1.0, 1.9, 2.8. The syncer
#        goes by it: of 20 frames of depth, each 5 ms before its colour, 19 come as pairs when the stamps begin at 0,
#        none when they begin at 1 s or 10 s (all 40 frames come alone), and 19 again in Unix time, where no rate is
#        set.
# Seen:  pyrealsense2 2.59.1.11053, Python 3.11, Linux x86-64.
# Who:   users who replay recordings of other cameras, or test their own code, through software_device.
# What to do: pair by stamps oneself; or number the frames by their time: round(stamp_ms * rate / 1000).
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import ctypes
import sys
import time

import libusb_package
import numpy as np

ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)  # which RealSense's wheel lacks
import pyrealsense2 as rs

WIDTH, HEIGHT, RATE, FRAMES = 64, 48, 30, 20
kept = []  # pixels, which the frames only point to


def stream(sensor, kind, pixel, bytes_, number):
    made = rs.video_stream()
    made.type, made.uid, made.width, made.height, made.fps, made.bpp, made.fmt = (
        kind,
        number,
        WIDTH,
        HEIGHT,
        RATE,
        bytes_,
        pixel,
    )
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = WIDTH, HEIGHT, 50, 50, WIDTH / 2, HEIGHT / 2
    made.intrinsics = lens
    return sensor.add_video_stream(made).as_video_stream_profile()


def send(sensor, profile, pixels, stamp_ms, number):
    kept.append(pixels)
    frame = rs.software_video_frame()
    frame.pixels, frame.stride, frame.bpp = pixels, pixels.strides[0], pixels.strides[1]
    frame.timestamp, frame.domain, frame.frame_number = stamp_ms, rs.timestamp_domain.hardware_clock, number
    frame.profile = profile
    sensor.on_video_frame(frame)


def replay(begin_ms, by_time=False):
    """How many pairs of 20 come, how many frames alone, and the rates that the first depth frames claim."""
    device = rs.software_device()
    depth, colour = device.add_sensor("Depth"), device.add_sensor("Color")
    of_depth = stream(depth, rs.stream.depth, rs.format.z16, 2, 0)
    of_colour = stream(colour, rs.stream.color, rs.format.rgb8, 3, 1)
    device.create_matcher(rs.matchers.default)
    syncer = rs.syncer(200)
    for sensor, profile in ((depth, of_depth), (colour, of_colour)):
        sensor.open(profile)
        sensor.start(syncer)
    sizes, rates, claimed = [], {}, rs.frame_metadata_value.actual_fps

    def receive(wait_ms):
        while True:
            came, frames = syncer.try_wait_for_frames(wait_ms)
            if not came:
                return
            sizes.append(frames.size())
            for frame in frames:
                if frame.profile.stream_type() == rs.stream.depth and frame.supports_frame_metadata(claimed):
                    rates[frame.frame_number] = round(frame.get_frame_metadata(claimed) / 1000, 1)

    for index in range(FRAMES):
        stamp_ms = begin_ms + index * 1000 / RATE
        number = round(stamp_ms * RATE / 1000) if by_time else index + 1
        send(depth, of_depth, np.full((HEIGHT, WIDTH), 1000, np.uint16), stamp_ms, number)
        time.sleep(0.005)
        send(colour, of_colour, np.zeros((HEIGHT, WIDTH, 3), np.uint8), stamp_ms + 5, number)
        time.sleep(0.005)
        receive(20)
    receive(300)
    return sizes.count(2), sizes.count(1), [rates[number] for number in sorted(rates)][:4]


found = {begin_ms: replay(begin_ms) for begin_ms in (0, 1_000, 10_000, 1_700_000_000_000)}
numbered = replay(10_000, by_time=True)
print("begin in ms: pairs of 20, frames alone, rates claimed:", found, "; from 10 s, numbered by time:", numbered)
pairs = [pair for pair, *_ in found.values()]
sys.exit(
    min(pairs[0], pairs[3], numbered[0]) < 15
    or max(pairs[1], pairs[2]) > 2
    or found[0][2] != [60.0, 45.0, 40.0, 37.5]
    or found[1_000][2][:3] != [1.0, 1.9, 2.8]
)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q pyrealsense2==2.59.1.11053 numpy==2.4.6 libusb-package==1.0.30.0
"$work/env/bin/python" "$work/try.py"
