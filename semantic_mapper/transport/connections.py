"""The connections of a subscribing socket: counted, and made again where ZeroMQ has given them up.

A connection that is lost is tried again by ZeroMQ itself, save one that is cut because the other side has broken the
protocol, such as by a message beyond MAXMSGSIZE: ZeroMQ gives that one up for good, and says no more than that it is
closed. An unknown client's single message would end a subscription for ever.
"""

from __future__ import annotations

import errno
import time
import uuid

import zmq
from zmq.utils.monitor import recv_monitor_message

from semantic_mapper.log_events import get_logger, is_power_of_two

GIVEN_UP_S = 0.3  # ZeroMQ says at once whether it tries again
_TRIES_AGAIN = (zmq.EVENT_CONNECT_RETRIED, zmq.EVENT_CONNECT_DELAYED, zmq.EVENT_CONNECTED)
_EVENTS = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED | sum(_TRIES_AGAIN)

_log = get_logger(__name__)


class Connections:
    """Watches the connections that a socket makes. To be used by the thread that uses the socket.

    Args:
        socket: Not connected yet.
    """

    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        self._socket = socket
        address = f"inproc://connections-{uuid.uuid4().hex}"
        socket.monitor(address, _EVENTS)
        self._monitor = socket.context.socket(zmq.PAIR)
        self._monitor.setsockopt(zmq.LINGER, 0)
        self._monitor.setsockopt(zmq.RCVHWM, 0)  # ZeroMQ's own thread would wait for us
        self._monitor.connect(address)
        self._lost: dict[str, float] = {}  # connections that are not tried again, and since when
        self._count = 0
        self.renewed = 0

    def connected(self) -> int:
        """How many publishers are connected right now; falls at once when one dies."""
        self._listen()
        return max(0, self._count)

    def mend(self) -> None:
        """Make those again that ZeroMQ has given up; often called, costs nothing."""
        self._listen()
        now = time.monotonic()
        for endpoint in [e for e, since in self._lost.items() if now - since > GIVEN_UP_S]:
            del self._lost[endpoint]
            self.renewed += 1
            try:
                self._socket.disconnect(endpoint)
            except zmq.ZMQError as error:
                if error.errno != errno.ENOENT:  # it knows nothing of that connection any more
                    raise
            self._socket.connect(endpoint)
            if is_power_of_two(self.renewed):
                _log.warning("connection_renewed", endpoint=endpoint, renewed=self.renewed)

    def close(self) -> None:
        """Before the socket is closed."""
        self._socket.disable_monitor()
        self._monitor.close(linger=0)

    def _listen(self) -> None:
        while self._monitor.poll(0):
            report = recv_monitor_message(self._monitor)
            event, endpoint = report["event"], report["endpoint"].decode(errors="replace")
            if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self._count += 1
            elif event == zmq.EVENT_DISCONNECTED:
                self._count -= 1
                self._lost[endpoint] = time.monotonic()
            else:
                self._lost.pop(endpoint, None)
