"""Questions of which only the newest matters: it is answered in a thread of its own, that begins with the first."""

from __future__ import annotations

import threading
from collections.abc import Callable


class NewestAsked:
    """Does the newest of what it is asked to do; `name` is its thread's."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._changed = threading.Condition()
        self._asked: Callable[[], None] | None = None
        self._thread: threading.Thread | None = None
        self._closed = False

    def submit(self, do: Callable[[], None]) -> None:
        """Have it done; one that still waits is left out for it."""
        with self._changed:
            self._asked = do
            self._changed.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Do no more."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._asked is not None)
                do, self._asked = self._asked, None
                if self._closed or do is None:
                    return
            do()
