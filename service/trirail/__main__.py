"""`trirail` and `python -m trirail`."""

from __future__ import annotations

import signal


def main() -> None:
    """Run a command. While the command line is loaded, a third of a second, Ctrl-C ends it as it ends any program."""
    handled = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # not where it is ignored, as under nohup
    if handled:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from trirail.cli import commands

    if handled:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    commands.main()


if __name__ == "__main__":
    main()
