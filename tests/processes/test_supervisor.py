"""The supervisor over children that do as they are told: who is killed, who is started again, and what is said."""

from __future__ import annotations

import errno
import itertools
import os
import random
import socket
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
import servers
from msgspec import structs
from trirail.config import SIM, Config, load
from trirail.errors import ServiceError
from trirail.kinematics.compiled import FUNCTIONS
from trirail.processes import forked_processes, supervisor
from trirail.processes.monitoring import Health
from trirail.telemetry import provenance
from trirail.wire.messages import Event
from waiting import WITHIN

pytestmark = pytest.mark.long

SERVER = """
import os, signal, sys, time
from pathlib import Path

from trirail.processes import compiling, fork_server
from trirail.wire.messages import Event

folder = Path({folder!r})
compiling.load = lambda: True

def begun(other):
    return (folder / f"{{other}}.begun").exists()

SUPERVISOR = os.getppid()

def never():
    return not Path(f"/proc/{{SUPERVISOR}}").exists()  # a test run that was killed leaves nobody behind

def freeze():
    while not never():
        time.sleep(0.1)

def goal(seq):
    return Event(seq=seq, t=0.0, cycle=seq, time=0.0, kind="goal", level="info", message="", id="g", outcome="done")

def work(child):
    name, heartbeats, ready = child.name, child.heartbeats, lambda: child.report_ready({{}})
    number = len(list(folder.glob(f"{{name}}-*.begun"))) + 1
    (folder / f"{{name}}-{{number}}.begun").touch()

    def beat_until(condition):
        heartbeats.heart(name).beat()
        while not (condition() or never()):
            time.sleep(0.01)
            heartbeats.heart(name).beat()

    def rest():
        if name != "drives":
            heartbeats.heart(name).rest()

    def loop_gone():
        return heartbeats.heart("loop").count == 0 or never()

    exec((folder / f"{{name}}-{{number}}").read_text(), globals() | locals())
    return 0
"""
CONFIG = load(SIM)
TURNING = "ready(); beat_until(never)"
RECORDING = "ready(); rest(); freeze()"
DYING = "ready(); beat_until(lambda: begun('up')); os._exit(1)"
HANGING = "ready(); beat_until(lambda: begun('up')); freeze()"
SERVING = (
    "ready(); beat_until(lambda: heartbeats.heart('loop').count); (folder / 'serving.begun').touch(); "
    "beat_until(loop_gone)"
)


class Told(list[str]):
    """What is told; with what begins so, the time in which a child is to be up becomes another."""

    def __init__(self, begins: str, start_within: float, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self._begins, self._start_within, self._patches = begins, start_within, monkeypatch

    def append(self, words: str) -> None:
        super().append(words)
        if words.startswith(self._begins):
            self._patches.setattr(supervisor, "START_WITHIN", self._start_within)


class Running:
    """Runs a supervisor over children that do what they are told, and keeps what it says."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.told: list[str] = []
        self.events: list[Event] = []
        self.health: Health
        self.record: Path | None = None
        """The file in which it is to record."""

    def ends(self, code: int, config: Config = CONFIG, /, **children: str) -> None:
        """Run it until it ends with an exit code.

        What is told has begun for the children: told-1 with the first of it, and up as soon as that is said.
        """
        for name, does in ({"drives_1": RECORDING, "planner_1": RECORDING, "recorder_1": RECORDING} | children).items():
            (self.folder / name.replace("_", "-")).write_text(does)

        def tell(words: str) -> None:
            self.told.append(words)
            (self.folder / f"told-{len(self.told)}.begun").touch()

        def up(_: object) -> None:
            tell("up")
            (self.folder / "up.begun").touch()

        supervised = supervisor.Supervisor(config, self.record, lambda words, _: tell(words), self.events.append)
        assert supervised.run(up) == code
        self.health = supervised._health


@pytest.fixture(autouse=True)
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Running:
    """Its children do what is written in files of their name and number."""
    monkeypatch.setattr(forked_processes, "ServerProcess", servers.doing(SERVER.format(folder=str(tmp_path)), tmp_path))
    monkeypatch.setattr(supervisor, "END_WITHIN", 0.5)
    return Running(tmp_path)


@pytest.fixture
def patient(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody is killed who only takes a busy machine's time to end."""
    monkeypatch.setattr(supervisor, "END_WITHIN", WITHIN)


def test_a_hung_gateway_is_killed_and_started_again(run: Running) -> None:
    run.ends(
        1,
        loop_1="ready(); beat_until(lambda: begun('gateway-2')); heartbeats.heart('loop').rest()",
        gateway_1=HANGING,
        gateway_2="ready()",
    )
    assert run.told[:2] == [
        "up",
        "the gateway has died (no sign of life for 0.7 s, so it was killed): the loop stops the robot and holds its "
        "position; "
        "restarting it",
    ]


@pytest.mark.generated(0, 1, 2)
def test_a_gateway_that_is_started_again_repeats_events_that_are_told_and_counted_once(run: Running, seed: int) -> None:
    """It is sent the newest of the events that were before it, and later ones."""
    chance = random.Random(seed)
    before, after = chance.randrange(1, 60), chance.randrange(20)
    first = chance.randrange(1, before + 1)
    tell = "ready()\nfor seq in range({}, {}): child.log(goal(seq))\n"
    run.ends(
        1,
        loop_1="ready(); beat_until(lambda: begun('all')); heartbeats.heart('loop').rest()",
        gateway_1=tell.format(1, before + 1) + DYING.removeprefix("ready(); "),
        gateway_2=tell.format(first, before + after + 1) + "(folder / 'all.begun').touch()",
    )
    assert [event.seq for event in run.events] == [*range(1, before + after + 1)]
    assert Counter(run.health.events.goals) == Counter(done=before + after)


def test_a_gateway_knows_whether_it_is_started_again(run: Running) -> None:
    tell = "(folder / f'{number}.again').write_text(str(child.order.again)); "
    run.ends(
        1,
        loop_1="ready(); beat_until(lambda: begun('gateway-2')); heartbeats.heart('loop').rest()",
        gateway_1=tell + DYING,
        gateway_2=tell + "ready()",
    )
    assert [(run.folder / f"{number}.again").read_text() for number in (1, 2)] == ["False", "True"]


def test_a_gateway_that_is_started_again_is_not_hung_before_its_first_sign_of_life(run: Running) -> None:
    run.ends(
        1,
        loop_1="ready(); beat_until(lambda: begun('gateway-3') or begun('slow')); heartbeats.heart('loop').rest()",
        gateway_1=DYING,
        gateway_2="time.sleep(1.5); (folder / 'slow.begun').touch(); ready()",  # longer than it may be silent later
        gateway_3="ready()",
    )
    assert (run.folder / "slow.begun").exists()


def test_a_gateway_that_hangs_in_its_start_is_killed(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    run.told = Told("up", 6.0, monkeypatch)
    run.ends(
        1,
        loop_1="ready(); beat_until(lambda: begun('gateway-3')); heartbeats.heart('loop').rest()",
        gateway_1="ready(); beat_until(lambda: begun('up'))",
        gateway_2="freeze()",
        gateway_3="ready()",
    )
    assert "no sign of life for 6 s, so it was killed" in run.told[2]


def test_a_frozen_loop_ends_the_service(run: Running) -> None:
    run.ends(
        1,
        loop_1=HANGING,
        gateway_1=TURNING,
    )
    assert run.told[1] == (
        "the loop has died (no sign of life for 0.7 s, so it was killed): the drives stop by their own watchdogs; the "
        "service ends"
    )


@pytest.mark.parametrize(
    ("name", "silent", "consequence"),
    [
        ("planner", 0.7, "the motion in progress continues, and new goals are refused"),
        ("recorder", 5, "the robot is not affected"),
    ],
)
def test_what_hangs_beside_the_loop_is_killed_and_started_again(
    name: str, silent: float, consequence: str, run: Running
) -> None:
    children = {
        "loop_1": f"ready(); beat_until(lambda: begun('{name}-2')); heartbeats.heart('loop').rest()",
        "gateway_1": SERVING,
        "recorder_1": RECORDING,
        f"{name}_1": HANGING,
        f"{name}_2": "ready()",
    }
    run.ends(1, **children)
    assert run.told[:2] == [
        "up",
        f"the {name} has died (no sign of life for {silent} s, so it was killed): {consequence}; restarting it",
    ]


def test_a_recorder_that_is_started_again_has_a_file_of_its_own(run: Running) -> None:
    """The first one's has what was recorded until then, and is refused as it is not empty."""
    run.record = run.folder / "named.rrd"
    dying = "(folder / f'{number}.file').write_text(str(child.order.record)); " + DYING
    run.ends(
        1,
        loop_1="ready(); beat_until(lambda: begun('recorder-3')); heartbeats.heart('loop').rest()",
        gateway_1=SERVING,
        recorder_1=dying,
        recorder_2=dying,
        recorder_3="ready()",
    )
    files = [(run.folder / f"{number}.file").read_text() for number in (1, 2)]
    assert files == [str(run.record), "None"]


def missing() -> str:
    raise FileNotFoundError


def unreadable() -> str:
    raise OSError(errno.EMFILE, "Too many open files")


@pytest.mark.parametrize(
    ("fingerprint", "warnings"),
    [(provenance.fingerprint, 0), (lambda: "another version", 1), (missing, 1), (unreadable, 0)],
)
def test_a_restart_after_an_update_of_the_installed_files_is_warned_of_once(
    run: Running, monkeypatch: pytest.MonkeyPatch, fingerprint: Callable[[], str], warnings: int
) -> None:
    assert provenance.software().source == provenance.fingerprint()
    monkeypatch.setattr(provenance, "fingerprint", fingerprint)
    run.ends(
        1,
        loop_1="ready(); beat_until(lambda: begun('gateway-3')); heartbeats.heart('loop').rest()",
        gateway_1=DYING,
        gateway_2=DYING,
        gateway_3="ready()",
    )
    changed = "the files of trirail have changed since the start, and restarted processes may fail"
    assert [words.startswith(changed) for words in run.told].count(True) == warnings


def test_each_restart_of_a_gateway_waits_longer_than_the_one_before(
    run: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses = (0.0, 0.05, 0.1, 0.15, 0.2)
    monkeypatch.setattr(supervisor, "RESTART_PAUSES_S", pauses)
    dying = {f"gateway_{number}": "os._exit(1)" for number in range(2, 7)}
    run.ends(1, loop_1=TURNING, gateway_1=DYING, **dying)
    died = "the gateway has died (exit code 1): the loop stops the robot and holds its position; restarting it"
    assert run.told[1:6] == [died, *(f"{died} in {pause:g} s" for pause in pauses[1:])]
    assert run.told[6] == "the gateway has died repeatedly (exit code 1): the service ends"
    began = [(run.folder / f"gateway-{number}.begun").stat().st_mtime for number in range(1, 7)]
    waited = [after - before for before, after in itertools.pairwise(began)]
    assert all(wait > pause - 0.01 for wait, pause in zip(waited, pauses, strict=True))


def test_restarts_of_long_ago_do_not_count(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor, "RESTART_PAUSES_S", (0.0,))
    monkeypatch.setattr(supervisor, "RESTART_PERIOD_S", 0.0)
    run.ends(
        1,
        loop_1="ready(); beat_until(lambda: begun('gateway-3')); heartbeats.heart('loop').rest()",
        gateway_1=DYING,
        gateway_2="os._exit(1)",
        gateway_3="ready()",
    )
    died = "the gateway has died (exit code 1): the loop stops the robot and holds its position; restarting it"
    assert run.told[:3] == ["up", died, died]


@pytest.mark.parametrize("name", ["planner", "recorder"])
def test_what_dies_repeatedly_beside_the_loop_is_started_again_and_again(
    name: str, run: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "RESTART_PAUSES_S", (0.0,))
    monkeypatch.setattr(supervisor, "RETRY_PAUSE_S", 0.05)
    children = {f"{name}_1": DYING, f"{name}_2": "os._exit(1)", f"{name}_3": "os._exit(1)", f"{name}_4": "ready()"}
    loop = f"ready(); beat_until(lambda: begun('{name}-4')); heartbeats.heart('loop').rest()"
    run.ends(1, loop_1=loop, gateway_1=SERVING, **children)
    died = f"the {name} has died (exit code 1): {supervisor.CONSEQUENCES[name]}; restarting it"
    assert run.told[:4] == ["up", died, f"{died} in 0.05 s", f"{died} in 0.05 s"]


def test_a_process_for_which_the_supervisor_has_no_descriptor_is_started_later(
    run: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipe = os.pipe

    def no_pipe() -> tuple[int, int]:
        if len(run.told) == 2:  # up, and that the recorder has died
            raise OSError(errno.ENFILE, "too many files")
        return pipe()

    monkeypatch.setattr(os, "pipe", no_pipe)
    run.ends(
        1,
        loop_1="ready(); beat_until(lambda: begun('recorder-2')); heartbeats.heart('loop').rest()",
        gateway_1=SERVING,
        recorder_1=DYING,
        recorder_2="ready()",
    )
    assert run.told[2] == "cannot restart the recorder (too many files): trying again in 1 s"


@pytest.mark.core
@pytest.mark.usefixtures("patient")
def test_those_that_end_because_the_loop_ends_are_not_started_again(run: Running) -> None:
    run.ends(
        1,
        loop_1="ready(); beat_until(lambda: begun('up') and begun('serving') and begun('recording')); "
        "heartbeats.heart(name).rest(); time.sleep(0.5)",
        gateway_1=SERVING,
        recorder_1="ready(); beat = heartbeats.heart('loop')\nwhile not beat.count: pass\n"
        "(folder / 'recording.begun').touch()\nwhile beat.count: pass",
    )
    assert run.told == [
        "up",
        "the loop has died (another process sent it SIGTERM): the loop has stopped the robot and disabled the drives; "
        "the service ends",
    ]


@pytest.mark.usefixtures("patient")
def test_a_loop_that_has_not_begun_has_stopped_nothing(run: Running) -> None:
    run.ends(1, loop_1="os.kill(os.getpid(), 15)", gateway_1="freeze()", recorder_1="freeze()")
    assert run.told == ["the loop has died (killed by SIGTERM): the loop had not started; the service ends"]


def test_a_first_start_is_waited_for_as_long_as_it_compiles(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    run.told = Told("the first start", 3.0, monkeypatch)
    compiling = f"""
for number in range({FUNCTIONS}):
    child.report_compiling(f"f{{number}}")
    time.sleep(4.0 / {FUNCTIONS})
"""
    end = "ready(); beat_until(lambda: begun('up')); heartbeats.heart('loop').rest()"
    run.ends(1, loop_1=compiling + end, gateway_1=SERVING)
    assert run.told[0].startswith(f"the first start compiles {FUNCTIONS} functions, which takes")
    assert run.told[1:4] == [f"compiling: {-(-FUNCTIONS * part // 4)} of {FUNCTIONS} functions" for part in (1, 2, 3)]
    assert run.told[4:6] == [f"compiling: {FUNCTIONS} of {FUNCTIONS} functions", "up"]


@pytest.mark.parametrize("sent", ["SIGINT", "SIGQUIT", "SIGHUP", "SIGTSTP", "SIGTTIN", "SIGTTOU"])
def test_the_terminals_interrupt_and_end_reach_no_child_not_even_one_that_is_still_importing(
    sent: str, run: Running
) -> None:
    """Ctrl-C, Ctrl-Z and its own end go to all of the terminal's processes: the supervisor alone acts on it."""
    interrupted = f"os.kill(os.getpid(), signal.{sent}); ready(); "
    turning = "beat_until(lambda: begun('up')); heartbeats.heart('loop').rest()"
    run.ends(1, loop_1=interrupted + turning, gateway_1=interrupted + "freeze()")
    assert run.told[0] == "up"


@pytest.mark.usefixtures("patient")
def test_a_service_cannot_be_suspended_and_says_how_it_ends(run: Running) -> None:
    """After Ctrl-Z, and in the background of a terminal that lets nobody write."""
    suspending = "".join(f"os.kill({os.getpid()}, signal.{sent}); " for sent in ("SIGTTIN", "SIGTTOU", "SIGTSTP"))
    stopping = "def end(*_): heartbeats.heart('loop').rest(); os._exit(0)\nsignal.signal(signal.SIGTERM, end)\n"
    ending = f"beat_until(lambda: begun('told-2')); os.kill({os.getpid()}, signal.SIGQUIT); beat_until(never)"
    loop = f"{stopping}ready(); beat_until(lambda: begun('up')); {suspending}{ending}"
    run.ends(0, loop_1=loop, gateway_1=SERVING, recorder_1=SERVING)
    assert run.told == [
        "up",
        "SIGTSTP: the service cannot be suspended; Ctrl-C stops the robot and ends the service",
        "SIGQUIT: stopping the robot and disabling the drives",
    ]


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("sent", ["SIGTERM", "SIGINT", "SIGQUIT", "SIGHUP"])
def test_a_start_that_is_interrupted_has_not_failed(sent: str, run: Running) -> None:
    """SIGTERM ends the children before they have said what it is to do."""
    interrupting = f"os.kill({os.getpid()}, signal.{sent}); freeze()"
    run.ends(0, loop_1=interrupting, gateway_1="freeze()", recorder_1="freeze()")
    assert run.told == [f"{sent}: the start was interrupted; nothing has moved"]


def test_who_does_not_end_is_a_failure_also_of_a_start_that_is_interrupted(run: Running) -> None:
    deaf = "signal.signal(signal.SIGTERM, signal.SIG_IGN); (folder / 'deaf.begun').touch(); freeze()"
    interrupting = f"beat_until(lambda: begun('deaf')); os.kill({os.getpid()}, signal.SIGTERM); freeze()"
    run.ends(1, loop_1=interrupting, gateway_1=deaf, recorder_1="freeze()")
    assert run.told[1] == "the gateway does not end: killing it"


def test_a_frozen_fork_server_ends_the_service_when_a_child_is_wanted(
    run: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody could bring the gateway back, and the robot would wait for it."""
    monkeypatch.setattr(supervisor, "FORKS_WITHIN", 0.5)
    run.ends(
        1,
        loop_1="ready(); beat_until(lambda: begun('gateway-2'))",
        gateway_1="ready(); beat_until(lambda: begun('up')); os.kill(os.getppid(), signal.SIGSTOP); os._exit(1)",
    )
    assert run.told[:3] == [
        "up",
        "the gateway has died (exit code unknown): the loop stops the robot and holds its position; restarting it",
        "the process that starts the others has died (no sign of life for 0.5 s, so it was killed): the loop stops the "
        "robot and disables the drives; the service ends",
    ]


def test_simulated_drives_that_die_are_told_and_come_back_with_the_next_service_alone(run: Running) -> None:
    """The loop has them in fault; those that would take their place would stand elsewhere, and not be set up."""
    run.ends(
        1,
        loop_1="ready(); beat_until(lambda: begun('told-2')); heartbeats.heart('loop').rest()",
        gateway_1=SERVING,
        drives_1="ready()\nwhile not (begun('up') or never()): time.sleep(0.01)\nos.kill(os.getpid(), signal.SIGKILL)",
    )
    assert run.told[:2] == [
        "up",
        "the simulated drives have died (killed by SIGKILL): the robot is in fault; restart the "
        "service to restart them",
    ]
    assert len(run.told) == 3, run.told
    assert not (run.folder / "drives-2.begun").exists()


@pytest.mark.usefixtures("patient")
def test_drives_that_end_since_the_loop_lets_go_of_them_are_not_told(run: Running) -> None:
    """A loop that cannot set them up has closed its bus before it has ended."""
    run.ends(
        1,
        loop_1="beat_until(lambda: begun('planner-1')); time.sleep(0.5); os._exit(1)",
        gateway_1=TURNING,
        drives_1="ready(); time.sleep(0.1)",
    )
    assert run.told == ["the loop has died (exit code 1): the loop had not started; the service ends"]


def test_an_end_while_a_recorder_is_started_again_is_in_order(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor, "END_WITHIN", 5.0)  # it is given so long
    stopping = "def end(*_): heartbeats.heart('loop').rest(); os._exit(0)\nsignal.signal(signal.SIGTERM, end)\n"
    run.ends(
        0,
        loop_1=f"{stopping}ready(); beat_until(lambda: begun('recorder-2')); os.kill({os.getpid()}, signal.SIGTERM); "
        "beat_until(never)",
        gateway_1=SERVING,
        recorder_1="ready()\nwhile not (begun('up') or never()): time.sleep(0.01)\nos._exit(1)",
        recorder_2="freeze()",
    )
    assert run.told[2:] == ["SIGTERM: stopping the robot and disabling the drives"]


def test_a_loop_has_the_time_to_end_that_its_drives_have_to_stop(
    run: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """systemd is told that the end takes so long."""
    config = structs.replace(CONFIG, drives=structs.replace(CONFIG.drives, stop_timeout=100.0))
    closing = "def end(*_): heartbeats.heart('loop').rest(); time.sleep(1.0); os._exit(0)\n"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told:
        told.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        run.ends(
            0,
            config,
            loop_1=f"{closing}signal.signal(signal.SIGTERM, end)\nready()\nbeat_until(lambda: begun('up'))\n"
            f"os.kill({os.getpid()}, signal.SIGTERM)\nbeat_until(never)",
            gateway_1=SERVING,
            recorder_1="ready()\nbeat_until(lambda: begun('serving') and loop_gone())\nos._exit(0)",
        )
        while not (state := told.recv(1000).decode()).startswith("STOPPING=1\n"):
            pass
    assert run.told[1:] == ["SIGTERM: stopping the robot and disabling the drives"]
    assert int(state.partition("EXTEND_TIMEOUT_USEC=")[2]) > 200e6


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("does", ["os._exit(3)", "time.sleep(0.2); os._exit(3)"])
def test_drives_that_cannot_start_are_the_end(does: str, run: Running) -> None:
    run.ends(1, loop_1="freeze()", gateway_1="freeze()", recorder_1="freeze()", drives_1=does)
    assert run.told == ["the drives could not start (exit code 3)"]


@pytest.mark.core
@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("other", ["planner", "drives", "recorder"])
@pytest.mark.parametrize("is_ready", [True, False])
def test_of_a_start_that_fails_the_loops_reason_alone_is_said(other: str, is_ready: bool, run: Running) -> None:
    """A process that loses its connection to a loop that cannot start ends by itself, before the loop has ended."""
    ends = f"{'ready()' if is_ready else 'pass'}\nwhile not (begun('failing') or never()): time.sleep(0.01)"
    fails = f"(folder / 'failing.begun').touch(); time.sleep(0.3); os._exit({os.EX_CONFIG})"
    run.ends(1, loop_1=fails, **{"gateway_1": "freeze()", f"{other}_1": ends})
    assert run.told == []


def test_a_real_bus_has_no_process_of_drives(run: Running) -> None:
    on_a_bus = structs.replace(CONFIG, can=structs.replace(CONFIG.can, interface="socketcan", channel="can0"))
    turning = "ready(); beat_until(lambda: begun('up')); heartbeats.heart('loop').rest()"
    run.ends(1, on_a_bus, loop_1=turning, gateway_1=SERVING)
    assert run.told[0] == "up"
    assert not (run.folder / "drives-1.begun").exists()


def test_the_end_of_the_users_session_takes_the_service_nothing_away(
    run: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """systemd then removes XDG_RUNTIME_DIR."""
    session = run.folder / "session"
    session.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(session))
    run.ends(
        1,
        loop_1="ready(); beat_until(lambda: begun('connected')); heartbeats.heart('loop').rest()",
        gateway_1=f"ready(); beat_until(lambda: begun('up')); import shutil; shutil.rmtree({str(session)!r})",
        gateway_2="from trirail.wire import links; links.connect(child.runtime / 'gateway'); "
        "(folder / 'connected.begun').touch(); ready()",
    )
    assert (run.folder / "connected.begun").exists()


def test_where_no_folder_for_sockets_can_be_made_that_is_told(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(run.folder / "gone"))
    with pytest.raises(ServiceError, match=r"cannot make a folder for sockets in .*: No such file .*; set TMPDIR to"):
        run.ends(1)


def test_a_runtime_folder_whose_path_is_too_long_for_sockets_is_refused_in_words(
    run: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = run.folder / ("x" * 100)
    deep.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(deep))
    with pytest.raises(ServiceError, match=r"cannot make sockets in .*: .*too long; set TMPDIR"):
        run.ends(1)
    assert not list(deep.iterdir())
