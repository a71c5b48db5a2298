"""Thread that runs Python code while the main thread runs compiled code, which does not need the interpreter."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from queue import Empty, SimpleQueue


class Companion:
    """Thread beside the main thread, with the rights of the main thread. It waits until its doorbell rings.

    With real-time scheduling its priority is one lower, so that the main thread preempts it on the same processor.
    """

    def __init__(self, answer: Callable[[], None]) -> None:
        """Prepare the thread, which calls `answer` when compiled code rings the doorbell."""
        self.doorbell = -1
        """Descriptor of an eventfd, after the start. Writing 1 to it wakes up the thread, once for each time."""
        self._answer = answer
        self._calls: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._errors: SimpleQueue[BaseException | None] = SimpleQueue()

    def start(self) -> None:
        """Start the thread, if it has not been started."""
        if self.doorbell < 0:
            self.doorbell = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_SEMAPHORE)
            threading.Thread(target=self._serve, name="companion", daemon=True).start()

    @contextlib.contextmanager
    def working(self, work: Callable[[], None] | None) -> Iterator[None]:
        """Run `work`, if any, in the thread while the body of the `with` statement runs; raise its error, if any."""
        if work is not None:
            self.start()
            self._calls.put(work)
            os.eventfd_write(self.doorbell, 1)
        try:
            yield
        finally:
            error = self._errors.get() if work is not None else None
        if error is not None:
            raise error

    def wait(self) -> None:
        """Wait for the end of the answer to a ring of compiled code; raise its error, if any."""
        if (error := self._errors.get()) is not None:
            raise error

    def _serve(self) -> None:
        priority = os.sched_getparam(0).sched_priority
        if priority > 1:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority - 1))
        while True:
            os.eventfd_read(self.doorbell)
            try:
                work = self._calls.get_nowait()
            except Empty:
                work = self._answer
            try:
                work()
            except BaseException as error:  # noqa: BLE001 - the main thread raises it
                self._errors.put(error)
            else:
                self._errors.put(None)
