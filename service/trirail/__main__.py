"""Entry point of `trirail` and `python -m trirail`."""

from __future__ import annotations

import io
import os
import signal
import sys


def main() -> None:
    """Run a command.

    Loading the command line takes a third of a second; during that time, Ctrl-C ends the process at signal level.
    """
    _open_standard_streams()
    signal.pthread_sigmask(signal.SIG_SETMASK, ())  # the program that has started this one may have blocked signals
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a command that has acted must not fail as it reports that
            stream.reconfigure(errors="backslashreplace")
    handled = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # nohup ignores it
    if handled:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from trirail.cli import app

    if handled:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    app.main()


def _open_standard_streams() -> None:
    """Open standard streams that were closed, for example by `>&-`.

    Otherwise the next file that a command opens would get the file descriptor of a standard stream.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
            os.set_inheritable(number, True)
    sys.stdin = sys.stdin or os.fdopen(0, closefd=False)
    sys.stdout = sys.stdout or os.fdopen(1, "w", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", closefd=False)


if __name__ == "__main__":
    main()
