"""A bidirectional stream on a connection of its own: the session's and the stop line's."""

import queue
import threading
import time
from collections.abc import Callable

import grpc


def now_ms() -> float:
    """The robot's own monotonic clock: the only one that authority and silence are measured with."""
    return time.monotonic() * 1000


def say(*words: object) -> None:
    print(*words, flush=True)


class Stream:
    """What comes down, and its end (None), goes into `inbox` with this stream: the one thing that a thread of its own does."""

    def __init__(self, channel: grpc.Channel, method: Callable, first, inbox: queue.Queue) -> None:
        self.channel = channel
        self.up: queue.Queue = queue.Queue(64)
        self.up.put(first)
        self.why = "the stream ended"
        self.call = method(iter(self.up.get, None))
        threading.Thread(target=self._read, args=(inbox,), daemon=True).start()

    def _read(self, inbox: queue.Queue) -> None:
        try:
            for message in self.call:
                inbox.put((self, message))
        except grpc.RpcError as error:
            self.why = f"{error.code().name} {error.details()}"
        inbox.put((self, None))

    def send(self, message) -> bool:
        """False: the way up is stuck."""
        try:
            self.up.put_nowait(message)
        except queue.Full:
            return False
        return True

    def close(self) -> None:
        self.call.cancel()
        self.channel.close()
