"""Ends of tools by signals, so that the programs that a tool has started end as well."""

from __future__ import annotations

import signal


def interrupt_on_signals() -> None:
    """Raise KeyboardInterrupt on SIGINT, SIGTERM and the end of the terminal, SIGHUP.

    A shell makes background jobs ignore SIGINT, which the programs of a tool would inherit. A program that `nohup` has
    started continues to ignore SIGHUP.
    """
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    for number in numbers:
        signal.signal(number, signal.default_int_handler)
