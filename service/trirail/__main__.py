"""`trirail` and `python -m trirail`."""

from __future__ import annotations

import os
import signal
import sys


def main() -> None:
    """Run a command. While the command line is loaded, a third of a second, Ctrl-C ends it as it ends any program."""
    _open_standard_streams()
    handled = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # not where it is ignored, as under nohup
    if handled:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from trirail.cli import app

    if handled:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    app.main()


def _open_standard_streams() -> None:
    """Open those that are closed, as by `>&-`: else what a command opens has their number, and is written to."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
            os.set_inheritable(number, True)
    sys.stdin = sys.stdin or os.fdopen(0, closefd=False)
    sys.stdout = sys.stdout or os.fdopen(1, "w", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", closefd=False)


if __name__ == "__main__":
    main()
