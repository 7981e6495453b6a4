#!/bin/sh
# Guess: a client of Foxglove's websocket server that subscribes to a channel as soon as the server advertises it
#        receives what is logged on that channel from then on.
# Found: now and then the server answers the subscription with a status "Unknown channel ID" and forgets it. The channel
#        is advertised an instant before subscriptions to it are taken, so a quick client of a channel that is created
#        while it is connected receives nothing, ever, with no error but that status; a second subscription works.
# Seen:  foxglove-sdk 0.30.3, Python 3.11, Linux x86-64: 1 of 10 to 2,000 connections.
# Who:   scripts that record or bridge topics of a robot whose channels appear as its cameras start.
# What to do: on such a status subscribe again.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q foxglove-sdk==0.30.3 websockets==15.0.1
cat > "$work/try.py" <<'PY'
import json
import sys
import threading
import time

import foxglove
from websockets.sync.client import connect
from websockets.typing import Subprotocol

ROUNDS = 30_000


def subscribe(socket, channel):
    socket.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 0, "channelId": channel}]}))


def one_round(delay_s):
    """Whether the first subscription was refused, and whether a message came after at most two."""
    context, done = foxglove.Context(), threading.Event()
    server = foxglove.start_server(host="127.0.0.1", port=0, context=context)

    def publish():
        time.sleep(delay_s)
        channel = foxglove.Channel("/topic", schema={"type": "object"}, context=context)
        while not done.is_set():
            if channel.has_sinks():
                channel.log({"value": 1})
            time.sleep(0.001)

    thread = threading.Thread(target=publish)
    thread.start()
    refused = came = False
    channel = 0
    with connect(f"ws://127.0.0.1:{server.port}", subprotocols=[Subprotocol("foxglove.sdk.v1")]) as socket:
        end = time.monotonic() + 5
        while not came and time.monotonic() < end:
            try:
                message = socket.recv(timeout=0.2)
            except TimeoutError:
                if refused:
                    subscribe(socket, channel)
                continue
            if isinstance(message, bytes):
                came = True
                continue
            said = json.loads(message)
            if said["op"] == "advertise" and said["channels"]:
                channel = said["channels"][0]["id"]
                subscribe(socket, channel)
            elif said["op"] == "status":
                refused = "Unknown channel" in said["message"]
    done.set()
    thread.join()
    server.stop()
    return refused, came


for number in range(ROUNDS):
    refused, came = one_round((number % 50) * 1e-4)
    assert came, "no message after a second subscription"
    if refused:
        print(f"connection {number}: refused at first, received after a second subscription")
        sys.exit(0)
sys.exit(f"no subscription of {ROUNDS} was refused: the behaviour has changed")
PY
"$work/venv/bin/python" "$work/try.py" 2>"$work/log" || { tail -n 5 "$work/log"; exit 1; }
