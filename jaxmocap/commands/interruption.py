"""Ctrl-C, and the signal to terminate, as a wish: what is under way is brought to an end."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_LOOK_SECONDS = 0.1


class Interruption:
    """`asked` from the first signal on; the second one raises KeyboardInterrupt wherever it finds us."""

    def __init__(self) -> None:
        self.asked = False

    def signalled(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True

    def sleep(self, until: float) -> None:
        """Until this time of `time.monotonic`, or until asked."""
        while not self.asked and (left := until - time.monotonic()) > 0:
            time.sleep(min(left, _LOOK_SECONDS))


@contextmanager
def interruption() -> Iterator[Interruption]:
    """Listens for signals, where these can be listened for: in the main thread."""
    found = Interruption()
    if threading.current_thread() is not threading.main_thread():
        yield found
        return
    before = {number: signal.signal(number, found.signalled) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield found
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
