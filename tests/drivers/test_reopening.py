"""A bus that is lost and comes back: opened again without holding up a cycle, its drives configured, the robot used."""

from __future__ import annotations

import errno
import random
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress

import can
import pytest
from control_rig import ControlRig
from drivers.test_recovery import ENDS, REAL, RecoveryRig, disabled, holding, moving
from drivers.test_recovery_matrix import stopping
from processes.test_compiled_cycles import odrives
from trirail.config import Config
from trirail.errors import RefusalCode
from trirail.wire.packets import CommandDone, Refused
from trirail.wire.vocabulary import Mode
from trirail_drivers.bus import wire as wires
from trirail_drivers.bus.can_frame import CAN_FRAME
from trirail_drivers.bus.frame_io import FrameIO, PythonCanFrames, SocketFrames
from trirail_drivers.bus.frames import packed, unpacked
from trirail_drivers.bus.reopening import RETRY_AFTER, AbsentBus, Reopening, start_thread
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.errors import BusAbsentError
from trirail_drivers.interface import PowerState
from trirail_drivers.protocols import PROTOCOLS

NUMBERS = (errno.ENETDOWN, errno.ENODEV, errno.ENXIO, errno.EIO)
BUS_OFF = can.Message(arbitration_id=0x40, is_error_frame=True, dlc=8, data=bytes(8))


class FailingSocket(socket.socket):
    """A bus' socket that fails when it is told to."""

    bus: FailingBus

    def send(self, data: bytes, flags: int = 0) -> int:  # type: ignore[override]
        self.bus.meet("send")
        return super().send(data, flags)

    def recv_into(self, buffer: bytearray, nbytes: int = 0, flags: int = 0) -> int:  # type: ignore[override]
        self.bus.meet("recv")
        return super().recv_into(buffer, nbytes, flags)


class FailingBus(can.BusABC):
    """One end of a bus, for python-can and as a socket, with the simulated drives behind it."""

    def __init__(self, rig: BusRig) -> None:
        self.rig, self.fails, self.closed = rig, dict[str, Exception](), False
        self.channel_info = "failing"
        self.arrived: deque[can.Message] = deque()
        here, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.carrier = FailingSocket(socket.AF_UNIX, socket.SOCK_SEQPACKET, 0, here.detach())
        self.carrier.bus = self
        self.far.setblocking(False)
        super().__init__("failing")

    def meet(self, call: str) -> None:
        assert not self.closed, "a bus is used that was shut down"
        if call in self.fails:
            raise self.fails[call]

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.meet("send")
        self.rig.simulated.send(msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self.meet("recv")
        if (found := self.arrived.popleft() if self.arrived else self.rig.simulated.recv(0.0)) is None:
            self.rig.pass_time(timeout)
        return found

    def pump(self) -> None:
        """Bring to the drives what the socket was given, and back what they say; nothing where it is python-can's."""
        with suppress(BlockingIOError):
            while True:
                self.rig.simulated.send(unpacked(self.far.recv(CAN_FRAME.size)))
        if self.rig.way == "socket":
            while self.arrived:
                self.far.send(packed(self.arrived.popleft()))
            while (message := self.rig.simulated.recv(0.0)) is not None:
                with suppress(BlockingIOError):
                    self.far.send(packed(message))

    def shutdown(self) -> None:
        self.closed = True
        self.carrier.close()
        self.far.close()
        super().shutdown()


def frames(way: str) -> Callable[[can.BusABC], FrameIO]:
    """Frames of a FailingBus by one way."""

    def made(bus: can.BusABC) -> FrameIO:
        return SocketFrames(bus.carrier) if way == "socket" and isinstance(bus, FailingBus) else PythonCanFrames(bus)

    return made


class BusRig(RecoveryRig):
    """A robot whose bus fails, and is opened by what the test says, when it says it."""

    def __init__(self, way: str, config: Config = REAL, *, absent: str = "", threads: bool = False) -> None:
        """`absent`: reason for which there is no bus at the start. `threads`: the bus is opened as the service does."""
        self.way = way
        self.rows, self.asked, self.sent, self.seen = [], [], [], []
        self.now = 90.0  # the cycles begin at 100
        self.simulated = self.bus = simulated_bus(config.can, config.drives, lambda: self.now)
        self._send, self.bus.send = self.bus.send, self._note  # type: ignore[method-assign,assignment]
        self.opened: list[FailingBus] = []
        self.pending: Callable[[], None] | None = None
        """The opening that is under way."""
        self.refusals: deque[Exception] = deque()
        """Reasons with which the next openings fail."""
        self.runs = False
        begin = start_thread if threads else self._begin
        reopening = Reopening("can0", self.open_bus, begin)
        bus: can.BusABC = AbsentBus("can0", absent) if absent else self.open_bus()
        driver = PROTOCOLS[config.drives.protocol].driver(
            bus, config.can.timing, config.drives, lambda: self.now, reopening
        )
        driver.configure(config.period, awaits=True)
        self.runs = True
        read = driver.read

        def pumped() -> object:
            for each in self.opened:
                if not each.closed:
                    each.pump()
            if all(each.closed for each in self.opened):
                while self.simulated.recv(0.0) is not None:  # the drives live on, and nobody hears them
                    pass
            return read()

        driver.read = pumped  # type: ignore[method-assign,assignment]
        ControlRig.__init__(self, config, driver)

    def _begin(self, work: Callable[[], None]) -> None:
        assert self.pending is None, "one opening at a time"
        self.pending = work

    def pass_time(self, timeout: float | None) -> None:
        """Let the time of a wait pass, which set-up alone does."""
        if not self.runs:
            self.now += timeout or 0.0

    def open_bus(self) -> can.BusABC:
        assert all(each.closed for each in self.opened), "an adapter can be opened once"
        if self.refusals:
            raise self.refusals.popleft()
        self.opened.append(FailingBus(self))
        return self.opened[-1]

    def finish(self) -> None:
        """Let the opening under way come to its end."""
        work, self.pending = self.pending, None
        assert work is not None
        work()

    def fail(self, trouble: dict[str, Exception]) -> None:
        self.opened[-1].fails = trouble

    @property
    def down(self) -> bool:
        return any("is down" in line for line in self.control.measured.unready)

    def stands(self) -> bool:
        """Whether it is past the time in which the drives may be stopping."""
        return self.mode is Mode.FAULT and not self.control.measured.powered

    def close(self) -> None:
        for each in self.opened:
            each.shutdown()
        self.simulated.shutdown()


@pytest.fixture(params=["python-can", "socket"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(wires, "frame_io", frames(request.param))
    return str(request.param)


@pytest.fixture
def rig(way: str) -> Iterator[BusRig]:
    made = BusRig(way)
    yield made
    made.close()


def trouble(draw: random.Random, way: str) -> dict[str, Exception]:
    """How a bus fails: by either call or both, with a number or, by python-can, without."""
    number = draw.choice(NUMBERS)
    kinds: list[Exception] = [OSError(number, "it is gone")]
    if way == "python-can":
        kinds += [
            can.CanOperationError("adapter unplugged"),
            can.CanOperationError("adapter unplugged", number),
            can.CanInitializationError("adapter not ready"),
            can.CanTimeoutError("no answer of the adapter"),
        ]
    error = draw.choice(kinds)
    return dict.fromkeys(draw.choice((("send",), ("recv",), ("send", "recv"))), error)


def refusals(draw: random.Random) -> list[Exception]:
    """Reasons with which a bus does not open, so many times."""
    kinds = (
        BusAbsentError('there is no CAN interface "can0"'),
        can.CanInitializationError("cannot bind"),
        OSError(errno.ENODEV, "No such device"),
        NameError("a maker's library"),
    )
    return [draw.choice(kinds) for _ in range(draw.choice((0, 1, 3)))]


@pytest.mark.generated(0, 3, 5, 9)
def test_a_bus_that_is_lost_comes_back(rig: BusRig, seed: int) -> None:
    """In any mode, however it fails, however often it does not open, however long that takes, once more or not.

    Seed 9: drives restart while the bus is lost in the middle of their configuration.
    """
    draw = random.Random(seed)
    draw.choice((disabled, holding, moving, stopping))(rig)
    for _ in range(draw.choice((1, 1, 2))):
        rig.refusals.extend(refusals(draw))
        rig.fail(trouble(draw, rig.way))
        rig.until(lambda: rig.down)
        assert rig.mode is Mode.FAULT
        rig.until(lambda: rig.pending is not None)
        if draw.random() < 0.3:
            rig.cut(0, 1, 2)
            rig.supply(0, 1, 2)
        while rig.down:
            rig.cycles(draw.choice((0, 1, 300)))  # none of these waits for the opening
            if rig.pending is not None:
                rig.finish()
            rig.cycles(1)
            answer = rig.command("reset") if draw.random() < 0.2 and rig.down else None
            assert not isinstance(answer, CommandDone)
        if draw.random() < 0.5:
            rig.cycles(draw.randrange(400))  # of the configuration
    rig.recover()
    assert rig.said("CAN bus can0 is down: ")
    assert rig.said("CAN bus can0 is up again")
    assert len(rig.opened) >= 2


def test_reset_is_refused_with_the_reason_until_the_bus_is_back(rig: BusRig) -> None:
    moving(rig)
    rig.refusals.append(BusAbsentError('there is no CAN interface "can0"; bring it up'))
    rig.fail({"send": OSError(errno.ENETDOWN, "Network is down")})
    rig.until(rig.stands)
    assert "CAN bus can0 is down: cannot send: [Errno 100]" in str(rig.control.fault)
    assert "bring it up: ip link set can0 up" in str(rig.control.fault)
    answer = rig.command("reset")
    assert isinstance(answer, Refused)
    assert answer.code is RefusalCode.FAULT
    assert answer.message.count("CAN bus can0 is down: cannot send") == 1
    rig.finish()
    rig.cycles(1)
    answer = rig.command("reset")
    assert isinstance(answer, Refused)
    assert 'the cause of the fault persists: CAN bus can0 is down: there is no CAN interface "can0"' in answer.message
    rig.until(lambda: rig.pending is not None)
    rig.finish()
    rig.recover()


def test_drives_are_stopped_over_a_bus_that_only_cannot_be_heard(rig: BusRig) -> None:
    """It is given up once they stand: until then it carries their quick stop."""
    moving(rig)
    rig.fail({"recv": OSError(errno.EIO, "it is deaf")})
    rig.cycles(10)
    assert {drive.power for drive in rig.drives} == {PowerState.QUICK_STOP_ACTIVE}
    assert rig.pending is None
    rig.until(lambda: rig.pending is not None)
    rig.finish()
    rig.recover()


def test_bus_off_is_a_bus_that_is_lost(rig: BusRig) -> None:
    moving(rig)
    rig.opened[-1].arrived.append(BUS_OFF)
    rig.until(lambda: rig.pending is not None)
    assert "CAN bus can0 is down: bus-off: " in str(rig.control.fault)
    rig.finish()
    rig.recover()


def test_a_full_queue_of_python_cans_is_no_flicker(rig: BusRig) -> None:
    """Without a number nobody knows whether the adapter is there: only a frame that arrives tells that it is back."""
    if rig.way == "socket":
        pytest.skip("a socket has numbers")
    moving(rig)
    rig.cut(0, 1, 2)
    rig.cycles(50)
    for _ in range(5):
        rig.fail({"send": can.CanOperationError("Transmit buffer full")})
        rig.until(lambda: rig.pending is not None)
        rig.finish()
        rig.cycles(100)
        assert rig.down
    assert len(rig.said("CAN bus can0 is down: ")) == 1
    assert not rig.said("CAN bus can0 is up again")
    rig.supply(0, 1, 2)
    rig.recover()


def test_an_opening_that_hangs_holds_up_no_cycle(way: str) -> None:
    """In the thread that the service has for it."""
    rig = BusRig(way, threads=True)
    moving(rig)
    hangs, entered = threading.Event(), threading.Event()
    open_bus = rig._bus_opener = rig.driver._wire._reopening._open  # type: ignore[attr-defined]

    def hang() -> can.BusABC:
        entered.set()
        assert hangs.wait(60.0)
        return open_bus()  # type: ignore[no-any-return]

    rig.driver._wire._reopening._open = hang  # type: ignore[attr-defined]
    rig.fail({"send": OSError(errno.ENODEV, "No such device")})
    rig.cycles(3)
    assert entered.wait(60.0)
    before = rig.control.cycles
    rig.cycles(2000)
    assert rig.control.cycles == before + 2000
    assert rig.down
    hangs.set()
    for thread in threading.enumerate():
        if thread.name == "bus":
            thread.join()
    rig.recover()
    rig.close()


@pytest.mark.parametrize("config", [REAL, odrives()], ids=["cia402", "odrive"])
@pytest.mark.generated(0, 1)
@pytest.mark.long
def test_a_service_that_starts_without_a_bus_uses_it_when_it_appears(way: str, config: Config, seed: int) -> None:
    draw = random.Random(seed)
    rig = BusRig(way, config, absent='there is no CAN interface "can0"; bring it up')
    rig.cycles(draw.randrange(1, 10))
    assert rig.mode is Mode.FAULT
    assert rig.control.fault == 'CAN bus can0 is down: there is no CAN interface "can0"; bring it up'
    rig.refusals.extend(refusals(draw))
    if draw.random() < 0.5:
        rig.cut(1)
        rig.supply(1)
    while rig.down:
        rig.cycles(draw.choice((1, 600)))
        if rig.pending is not None:
            rig.finish()
        rig.cycles(1)
    rig.recover()
    rig.close()


@pytest.mark.usefixtures("absolute_odrives")
@pytest.mark.generated(0, 1, 2)
def test_odrives_go_on_when_their_bus_is_back(seed: int) -> None:
    draw = random.Random(seed)
    rig = BusRig("python-can", odrives())
    rig.cycles(300)
    rig.enable()
    rig.refusals.extend(refusals(draw))
    rig.fail(trouble(draw, rig.way))
    rig.until(lambda: rig.down)
    while rig.down:
        rig.cycles(draw.choice((1, 300)))
        if rig.pending is not None:
            rig.finish()
        rig.cycles(1)
    rig.until(rig.ready, ENDS)
    rig.cycles(300)
    assert isinstance(rig.command("reset"), CommandDone)
    rig.cycles(300)
    rig.enable()
    rig.goal("after", 0.005, 0.0, 0.0)
    rig.until(lambda: ("after", "done") in rig.outcomes())
    rig.close()


def test_a_bus_that_opens_after_the_end_is_closed(rig: BusRig) -> None:
    rig.fail({"send": OSError(errno.ENODEV, "No such device")})
    rig.until(lambda: rig.pending is not None)
    rig.driver._wire.close()  # type: ignore[attr-defined]
    rig.finish()
    assert all(each.closed for each in rig.opened)


def test_a_bus_that_has_opened_and_was_not_taken_is_closed_at_the_end(rig: BusRig) -> None:
    rig.fail({"send": OSError(errno.ENODEV, "No such device")})
    rig.until(lambda: rig.pending is not None)
    rig.finish()
    rig.driver._wire.close()  # type: ignore[attr-defined]
    assert all(each.closed for each in rig.opened)


def test_without_room_for_a_thread_the_attempt_has_failed_and_another_follows() -> None:
    """The lost bus is closed then, before another is opened: most adapters can be opened only once."""
    lost, bus = AbsentBus("can0"), AbsentBus("can0")
    full = [True]

    def opened() -> can.BusABC:
        assert lost._is_shutdown
        return bus

    def start(work: Callable[[], None]) -> None:
        if full.pop():
            raise RuntimeError("can't start new thread")
        work()

    reopening = Reopening("can0", opened, start)
    reopening.retire(lost)
    assert reopening.attempt(0.0) is None
    full.append(False)
    assert reopening.attempt(0.1) == "can't start new thread"
    assert reopening.attempt(0.2) is None
    assert reopening.attempt(0.1 + 2 * RETRY_AFTER) is None
    assert reopening.attempt(0.2 + 2 * RETRY_AFTER) is bus


def test_without_room_for_a_thread_the_lost_bus_is_closed_by_a_later_attempt() -> None:
    """Most adapters cannot be opened before."""
    closed: list[str] = []
    full = [False, True]

    class Lost(AbsentBus):
        def shutdown(self) -> None:
            closed.append(self.channel_info)
            super().shutdown()

    def start(work: Callable[[], None]) -> None:
        if full.pop():
            raise RuntimeError("can't start new thread")
        work()

    reopening, lost = Reopening("can0", lambda: AbsentBus("can0", ""), start), Lost("lost")
    reopening.retire(lost)
    reopening.attempt(0.0)
    assert reopening.attempt(0.1) == "can't start new thread"
    assert closed == []
    reopening.attempt(0.1 + 2 * RETRY_AFTER)
    assert closed == ["lost"]
