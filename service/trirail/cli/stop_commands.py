"""`trirail stop`, `quick-stop`, `disable`: they do not wait for a session, which a flooded port may not provide."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable
from threading import Thread, Timer

from trirail.cli import terminal
from trirail.cli.options import HERE, Service
from trirail.cli.robot_commands import confirmed
from trirail.wire.vocabulary import Command

ANSWER_S = 5.0
"""Time without an answer after which a message says that the command still waits [s]. A refusal takes up to 3 s."""


def stopping(name: Command) -> Callable[..., int]:
    """Return the function of the command line that sends one of trirail.wire.stop_protocol.STOPS."""

    def stop(*, service: Service = HERE) -> int:
        from trirail.client.new_stop import NewStop

        asked = NewStop(name, service.robot, service.connect, service.tls)
        words = f"{name}: no answer from {service.connect} yet; still trying, Ctrl-C gives up"
        silence = Timer(ANSWER_S, terminal.print_error, (words,))
        silence.daemon = True
        try:
            with contextlib.suppress(RuntimeError):  # no thread can be started
                silence.start()
            reply = asked.wait()
            silence.cancel()
            confirmed(service, name, reply)
            sys.stdout.flush()
        except BaseException:
            silence.cancel()
            _join(asked.opening)
            raise
        if asked.opening.is_alive():  # it may take seconds
            os._exit(0)
        return 0

    return stop


def _join(opening: Thread) -> None:
    """Wait for the thread, as the interpreter cannot end while Zenoh's code runs. Ctrl-C ends the process."""
    try:
        opening.join()
    except KeyboardInterrupt:
        os._exit(130)
