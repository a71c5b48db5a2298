"""The warm process: forks `trirail` with arguments, for tests: python warm_parent.py CONTROL, as warm.py starts it.

On CONTROL, a SEQPACKET socket, it takes requests, each with the descriptor of a socket where it says the process id and
how that ended, and those of what the program prints to.
"""

from __future__ import annotations

import contextlib
import gc
import io
import json
import os
import select
import signal
import socket
import sys
import traceback
from pathlib import Path
from typing import Final, NoReturn

from setproctitle import setproctitle
from trirail.processes.realtime import die_with_parent

LARGEST: Final = 1 << 17
"""Bytes of a request."""


class Warm:
    """Forks programs on request, says how they end, and keeps each one's number until that is heard."""

    def __init__(self, control: socket.socket) -> None:
        self._control = control
        self._poll = select.poll()
        self._poll.register(control, select.POLLIN)
        self._running: dict[int, tuple[int, socket.socket]] = {}
        """By pidfd: process id, and where its end is told."""
        self._over: dict[int, tuple[int, socket.socket]] = {}
        """By the descriptor where its end has been told: process id."""

    def serve(self) -> None:
        """Serve until nobody can ask any more."""
        while True:
            for descriptor, _ in self._poll.poll():
                if descriptor in self._running:
                    self._tell(descriptor)
                elif descriptor in self._over:
                    self._forget(descriptor)
                elif not self._receive():
                    return

    def _receive(self) -> bool:
        packet, descriptors, _, _ = socket.recv_fds(self._control, LARGEST, 3)
        if not packet:
            return False
        voice, *outputs = descriptors
        pid = os.fork()
        if pid == 0:
            self._control.close()
            for pidfd, (_, other) in self._running.items():
                os.close(pidfd)
                other.close()
            os.close(voice)
            _program(json.loads(packet), outputs)
        for output in outputs:
            os.close(output)
        told = socket.socket(fileno=voice)
        told.send(str(pid).encode())
        pidfd = os.pidfd_open(pid)
        self._running[pidfd] = pid, told
        self._poll.register(pidfd, select.POLLIN)
        return True

    def _tell(self, pidfd: int) -> None:
        pid, voice = self._running.pop(pidfd)
        ended = os.waitid(os.P_PIDFD, pidfd, os.WEXITED | os.WNOWAIT)
        assert ended is not None
        self._poll.unregister(pidfd)
        os.close(pidfd)
        with contextlib.suppress(BrokenPipeError):
            voice.send(str(ended.si_status if ended.si_code == os.CLD_EXITED else -ended.si_status).encode())
        self._over[voice.fileno()] = pid, voice
        self._poll.register(voice, 0)  # till it is hung up

    def _forget(self, descriptor: int) -> None:
        pid, voice = self._over.pop(descriptor)
        self._poll.unregister(descriptor)
        voice.close()
        os.waitpid(pid, 0)


def _program(request: dict[str, object], outputs: list[int]) -> NoReturn:
    """Be `trirail` with these arguments."""
    code: object = 1
    try:
        arguments, folder, environment = request["arguments"], request["folder"], request["environment"]
        assert isinstance(arguments, list)
        assert isinstance(folder, str)
        assert isinstance(environment, dict)
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(environment)
        os.setsid()
        die_with_parent(signal.SIGTERM)  # even if the parent is killed; it ends with the tests
        for output, name in zip(outputs, ("stdout", "stderr"), strict=True):
            stream = getattr(sys, name)
            os.dup2(output, stream.fileno())
            os.close(output)
            # A new stream: the old one takes its file for what it was, one with a place in it or a pipe.
            raw = os.fdopen(stream.fileno(), "wb", closefd=False)
            setattr(sys, name, io.TextIOWrapper(raw, stream.encoding, stream.errors))
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        sys.argv = ["trirail", *arguments]
        from trirail.__main__ import main

        main()
        code = 0
    except SystemExit as ended:
        code = ended.code
    except BaseException:  # noqa: BLE001 - nothing of this process may return into that of the parent
        traceback.print_exc()
    _leave(code)


def _leave(code: object) -> NoReturn:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else 0 if code is None else 1)


def main() -> None:
    """Load what services need, and fork them."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # who runs the tests ends it
    setproctitle("warm parent of services")  # it looks for where its title is once, with the environment as it was
    from trirail.cli import app  # noqa: F401 - what is imported here nobody else has to
    from trirail.processes import compiling, fork_server, supervisor  # noqa: F401 - as above

    if not compiling.load():
        compiling.compile_all(lambda _: None)
    sys.path.append(str(Path(__file__).parent))
    import parsed_eds
    from trirail.config import SIM, load
    from trirail_drivers.connection.opening import simulated_bus

    parsed_eds.stand_between(parsed_eds.import_od, parsed_eds.compact_arrays, parsed_eds.sections_of)
    shipped = load(SIM)
    simulated_bus(shipped.can, shipped.drives).shutdown()  # parses for all services that have these drives
    gc.collect()
    gc.freeze()
    with socket.socket(fileno=int(sys.argv[1])) as control:
        Warm(control).serve()  # programs that are still running end with this process


if __name__ == "__main__":
    main()
