"""Tools that are ended by a signal, or fail, end the programs that they have started.

None reports a success if it ran nothing.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import chaos
import chaos_rig
import flood
import flood_memory
import pytest
from trirail.client import own_service
from trirail.errors import ServiceError
from waiting import wait_until

TOOLS = Path(__file__).parents[2] / "tools"
WAITING = """
import sys, time
sys.path.insert(0, sys.argv[1])
from interruption import interrupt_on_signals
interrupt_on_signals()
try:
    print("waits", flush=True)
    time.sleep(60.0)
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("ignored", [signal.SIGINT, signal.SIGHUP])
def test_a_tool_is_interrupted_by_what_ends_it_except_by_the_end_of_its_terminal_under_nohup(
    number: signal.Signals, ignored: signal.Signals
) -> None:
    command = [sys.executable, "-c", WAITING, str(TOOLS)]
    before = signal.signal(ignored, signal.SIG_IGN)
    try:
        program = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    finally:
        signal.signal(ignored, before)
    with program:
        assert program.stdout is not None
        assert program.stdout.readline() == "waits\n"
        program.send_signal(number)
        if number == ignored == signal.SIGHUP:
            program.send_signal(signal.SIGKILL)
            assert program.stdout.read() == ""
        else:
            assert program.stdout.read() == "interrupted\n"


def test_a_kill_matrix_without_cases_is_an_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["chaos.py", "--only", "moving/lop"])
    with pytest.raises(SystemExit) as ended:
        chaos.main()
    assert ended.value.code == 2
    assert "no case is selected" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("drives_start", [True, False])
def test_the_kill_matrix_leaves_no_drives_if_its_first_service_does_not_start(
    drives_start: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    started: list[subprocess.Popen[Any]] = []

    class Noted(subprocess.Popen[Any]):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            started.append(self)

    def fail(*_: object, **__: object) -> None:
        raise ServiceError("the service could not start, see above")

    monkeypatch.setattr(subprocess, "Popen", Noted)
    monkeypatch.setattr(own_service, "start", fail)
    if not drives_start:
        monkeypatch.setattr(chaos_rig, "wait_for", fail)
    with pytest.raises(ServiceError), chaos_rig.running_rig(tmp_path):
        raise AssertionError("the service has not started")
    (drives,) = started
    with drives:  # closes its standard input
        wait_until(lambda: drives.poll() is not None, "the drives end")


@pytest.mark.slow
def test_a_flood_that_cannot_be_sent_is_a_failure() -> None:
    """At no message per second; the programs of the flood end with an error."""
    assert flood.run(0.5, 0.0) == ["a process of the flood has failed, see above"]


def test_a_flood_of_memory_that_has_not_run_is_a_failure() -> None:
    class Ended:
        exitcode = 1

        def is_alive(self) -> bool:
            return False

    ended: Any = Ended()
    assert list(flood_memory._stays("tokens by eva", ended, {}, {})) == [
        "tokens by eva: the flood itself has failed, see above"
    ]
