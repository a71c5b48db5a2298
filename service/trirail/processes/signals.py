"""Signals as something to wait for, beside pipes and sockets."""

from __future__ import annotations

import signal
import socket


class Signals:
    """SIGTERM, SIGINT and, where it is not ignored, as under nohup, SIGHUP as something to select on.

    Whichever thread the kernel hands a signal: Python's handlers are run by the main thread alone, which nothing wakes
    from a lock where another one was interrupted.
    """

    def __enter__(self) -> Signals:
        self.reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        numbers = [signal.SIGTERM, signal.SIGINT]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            numbers.append(signal.SIGHUP)
        self._before = {number: signal.signal(number, lambda _signal, _frame: None) for number in numbers}
        self._wakeup = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        return self

    def first(self) -> signal.Signals:
        """Return the signal that came first; wait for one."""
        return signal.Signals(self.reader.recv(1)[0])

    def __exit__(self, *_: object) -> None:
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self.reader.close()
        self._writer.close()
