"""Thread that runs Python code while the main thread runs compiled code, which does not need the interpreter."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from queue import SimpleQueue


class Companion:
    """Thread beside the main thread, started at the first call. It has the rights of the main thread.

    With real-time scheduling its priority is one lower, so that the main thread preempts it on the same processor.
    """

    def __init__(self) -> None:
        self._calls: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._errors: SimpleQueue[BaseException | None] = SimpleQueue()
        self._started = False

    @contextlib.contextmanager
    def working(self, work: Callable[[], None]) -> Iterator[None]:
        """Run `work` in the thread while the body of the `with` statement runs; raise the error of `work`, if any."""
        if not self._started:
            self._started = True
            threading.Thread(target=self._serve, name="companion", daemon=True).start()
        self._calls.put(work)
        try:
            yield
        finally:
            error = self._errors.get()
        if error is not None:
            raise error

    def _serve(self) -> None:
        priority = os.sched_getparam(0).sched_priority
        if priority > 1:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority - 1))
        while True:
            work = self._calls.get()
            try:
                work()
            except BaseException as error:  # noqa: BLE001 - the main thread raises it
                self._errors.put(error)
            else:
                self._errors.put(None)
