"""Requests by SDO in the cycle, to drives that need time for each and handle one at a time (CiA 301)."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import msgspec
import pytest
from drivers.test_cia402 import CONFIG, HOMING, Rig, changed
from rigs import STEP, Closing
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.axis import ANSWER_TIME
from trirail_drivers.cia402.one_drive import HAS_POWER
from trirail_drivers.config import NO_IO, DigitalIo, Drives
from trirail_drivers.interface import DriveFault, Feedback, PowerState
from trirail_drivers.simulated.device import Nmt
from trirail_drivers.simulated.sdo_queue import SdoQueue

VALVE: Final = 1 << 16
IO = (DigitalIo(VALVE), DigitalIo(VALVE), DigitalIo(VALVE))
PATIENT = msgspec.structs.replace(CONFIG, sdo_timeout=0.5)
HOMED = msgspec.structs.replace(changed("A", homing=HOMING), sdo_timeout=0.5)
STOPS: Final = [
    canopen_frames.CONTROLWORD_DOWNLOAD + canopen_frames.CONTROLWORD.pack(word) + bytes(2)
    for word in (canopen_frames.QUICK_STOP, canopen_frames.DISABLE_VOLTAGE)
]
SERVERS: Final = {"keeps the first": (1, False), "keeps the newest": (1, True), "queues": (8, False)}
TIMES: Final = (0.0, 0.002, 0.004, 0.006, 0.012, 0.03)
"""Times that a drive needs for a request [s]."""
HEARTBEAT: Final = 0.1


class SlowRig(Rig):
    """Drives that answer SDO slowly, and what they were asked although they had not answered yet."""

    def __init__(self, seconds: float, server: str, config: Drives = PATIENT, io: Sequence[DigitalIo] = NO_IO) -> None:
        super().__init__(config, io)
        self.seconds, self.server = seconds, server
        self.overlaps: list[tuple[int, bytes]] = []
        """Drive and request of each request that another one preceded, which was not answered."""

    def slow(self) -> None:
        """From now on, the drives are slow."""
        for index, device in enumerate(self.devices):
            queue = device.sdo_requests
            queue.answer_time = self.seconds
            queue.room, queue.replaces = SERVERS[self.server]
            vars(queue).update(receive=self._watched(index, queue, queue.receive))

    def _watched(
        self, index: int, queue: SdoQueue, receive: Callable[[bytes, float], None]
    ) -> Callable[[bytes, float], None]:
        def received(data: bytes, now: float) -> None:
            if len(queue):
                self.overlaps.append((index, bytes(data)))
            receive(data, now)

        return received

    def until(self, reached: Callable[[Feedback], bool], seconds: float) -> float:
        """Cycle until a feedback is as wanted; return the time that it took [s]."""
        begun = self.clock.now
        while not reached(feedback := self.cycle()):
            assert self.clock.now < begun + seconds, feedback
        return self.clock.now - begun

    def leave(self, state: Nmt, index: int = 0) -> None:
        """Let a drive leave NMT operational, as by the loss of its master or by another master."""
        self.devices[index]._enter(state)


def one_at_a_time(rig: SlowRig) -> bool:
    """Whether only commands to stop preceded an answer, and not more than one for each reason to stop."""
    stops = [data for _, data in rig.overlaps if data in STOPS]
    return len(stops) == len(rig.overlaps) <= 2 * 3


@pytest.mark.parametrize("server", SERVERS)
@pytest.mark.generated(*range(12))
def test_a_drive_that_leaves_operational_returns_however_slowly_it_answers(
    closing: Closing, server: str, seed: int
) -> None:
    """At a random cycle; it stops by itself, or must be stopped by SDO."""
    draw = random.Random(seed)
    rig = closing(SlowRig(draw.choice(TIMES), server, io=draw.choice((NO_IO, IO))))
    rig.period = draw.choice((STEP, STEP, 0.01))
    rig.drives.configure(rig.period)
    rig.slow()
    rig.enable()
    rig.cycles(draw.randrange(5, 150))
    index = draw.randrange(3)
    rig.devices[index].objects[0x6007, 0].value = draw.choice((0, 3))
    rig.leave(draw.choice((Nmt.PRE_OPERATIONAL, Nmt.STOPPED)), index)
    faults: list[DriveFault] = []

    def reached(*, ready: bool) -> Callable[[Feedback], bool]:
        def is_reached(feedback: Feedback) -> bool:
            faults.extend(filter(None, (feedback.fault,)))
            return bool(feedback.unready[index]) is not ready

        return is_reached

    rig.until(reached(ready=False), 0.3)
    rig.until(lambda _: rig.devices[index].state not in HAS_POWER, 0.1 + 6 * rig.seconds)
    rig.until(reached(ready=True), 2.0 + 300 * max(rig.seconds, rig.period))
    assert {fault.cause for fault in faults} <= {"silent", "state"}, "it is reported to have power, but it has none"
    assert one_at_a_time(rig)
    for _ in range(2):  # the drive may have reported the loss of its master
        rig.drives.reset()
        rig.cycles(30)
    rig.enable()


@pytest.mark.parametrize("server", SERVERS)
@pytest.mark.generated(*range(8))
def test_a_command_to_stop_does_not_wait_for_an_answer(closing: Closing, server: str, seed: int) -> None:
    """A slow drive is being asked for its outputs when it leaves operational, with power."""
    draw = random.Random(seed)
    rig = closing(SlowRig(draw.choice(TIMES[2:]), server, io=IO))
    a = rig.devices[0]
    a.objects[0x60FE, 1].mappable = False
    rig.ready()
    rig.slow()
    rig.enable()
    a.objects[0x6007, 0].value = 0
    end = draw.randrange(5, 100)
    for number in range(end + 5):
        rig.drives.set_outputs((VALVE * (number % 2), 0, 0))
        if number == end:
            rig.leave(Nmt.PRE_OPERATIONAL)
            rig.bus.sent.clear()
        feedback = rig.cycle()
        if feedback.fault is not None:
            break
    assert feedback.fault is not None
    assert STOPS[0] in rig.sent_to(canopen_frames.SDO_REQUEST)[0]
    # Where it was lost, it is sent again after the answer to the request before it.
    within = 3 * rig.seconds + 0.02
    assert rig.until(lambda _: a.state is not PowerState.OPERATION_ENABLED, within) <= within


@pytest.mark.parametrize("server", SERVERS)
@pytest.mark.parametrize("mapped", [True, False])
@pytest.mark.generated(*range(6))
def test_the_outputs_of_a_drive_that_leaves_operational_are_soon_safe(
    closing: Closing, server: str, mapped: bool, seed: int
) -> None:
    """By the cycle, or by the set-up that begins meanwhile."""
    draw = random.Random(seed)
    rig = closing(SlowRig(draw.choice(TIMES), server, io=IO))
    a = rig.devices[0]
    a.objects[0x60FE, 1].mappable = mapped
    rig.ready()
    rig.slow()
    rig.enable()
    rig.drives.set_outputs((VALVE, 0, 0))
    rig.cycles(draw.randrange(50, 150))
    assert a.pins.bits == VALVE
    rig.leave(Nmt.PRE_OPERATIONAL)
    rig.found("silent", 5)
    rig.drives.set_outputs((0, 0, 0))
    within = HEARTBEAT + 10 * max(rig.seconds, 2 * STEP)
    assert rig.until(lambda _: not a.pins.bits, within) <= within
    assert one_at_a_time(rig)


@pytest.mark.parametrize("safe", [0, VALVE])
def test_a_set_up_in_the_background_first_makes_the_outputs_safe(closing: Closing, safe: int) -> None:
    """Before anything is read that decides whether the drive may return."""
    rig = closing(SlowRig(0.0, "queues", io=[DigitalIo(VALVE, safe)] * 3))
    a = rig.devices[0]
    rig.ready()
    rig.drives.set_outputs((safe ^ VALVE, 0, 0))
    rig.cycles(5)
    assert a.pins.bits == safe ^ VALVE
    rig.leave(Nmt.PRE_OPERATIONAL)
    rig.until(lambda _: rig.drives._is_being_configured(rig.drives._axes[0]), 0.3)
    rig.bus.sent.clear()
    rig.until(lambda _: a.pins.bits == safe, 0.1)
    assert len(rig.sent_to(canopen_frames.SDO_REQUEST)[0]) < 30


@pytest.mark.parametrize("server", SERVERS)
@pytest.mark.generated(*range(6))
def test_polls_and_outputs_take_turns(closing: Closing, server: str, seed: int) -> None:
    """A drive whose statusword no PDO contains, and whose outputs change in each cycle."""
    draw = random.Random(seed)
    rig = closing(SlowRig(draw.choice(TIMES[1:]), server, io=IO))
    a = rig.devices[0]
    a.objects[0x60FE, 1].mappable = False
    rig.ready()
    rig.slow()
    axis = rig.drives._axes[0]
    axis.exchange = replace(axis.exchange, polled=True)
    rig.enable()
    asked = rig.bus.sent
    for number in range(1000):
        if number % draw.choice((1, 3, 50)) == 0:
            rig.drives.set_outputs((VALVE * draw.randrange(2), 0, 0))
        assert rig.cycle().fault is None
    polls = asked.count((canopen_frames.SDO_REQUEST + a.node, canopen_frames.STATUSWORD_UPLOAD))
    assert polls > 0.5 * 1.0 / (canopen_frames.POLL_PERIOD + 2 * rig.seconds)
    assert rig.overlaps == []
    rig.cycles(round(3 * rig.seconds / STEP) + 50)
    assert a.pins.bits == axis.outputs


@pytest.mark.parametrize("server", SERVERS)
@pytest.mark.generated(*range(6))
def test_homing_asks_one_thing_at_a_time(closing: Closing, server: str, seed: int) -> None:
    draw = random.Random(seed)
    rig = closing(SlowRig(draw.choice(TIMES[1:]), server, HOMED, io=IO))
    a = rig.devices[0]
    a.objects[0x60FE, 1].mappable = False
    a.homing.switch = a.servo.position + 2000
    rig.ready()
    rig.slow()
    axis = rig.drives._axes[0]
    axis.exchange = replace(axis.exchange, polled=draw.random() < 0.5)
    rig.enable()
    rig.drives.home()
    for number in range(6000):
        if number % 100 == 0:
            rig.drives.set_outputs((VALVE * draw.randrange(2), 0, 0))
        feedback = rig.cycle()
        assert feedback.fault is None
        if not feedback.homing:
            break
    assert feedback.homed[0]
    assert rig.overlaps == []


@pytest.mark.parametrize("server", SERVERS)
@pytest.mark.generated(*range(6))
def test_a_reset_asks_for_the_error_register_when_the_drive_has_answered(
    closing: Closing, server: str, seed: int
) -> None:
    draw = random.Random(seed)
    rig = closing(SlowRig(draw.choice(TIMES[1:]), server, io=IO))
    a = rig.devices[0]
    a.objects[0x60FE, 1].mappable = False
    rig.ready()
    rig.slow()
    rig.enable()
    rig.cycles(draw.randrange(5, 20))
    rig.bus.inject(canopen_frames.EMCY + a.node, canopen_frames.EMERGENCY.pack(0x4210, 1, bytes(5)))
    rig.found("emcy", 3)
    rig.drives.set_outputs((VALVE, 0, 0))
    rig.cycles(200)
    for number in range(3):
        rig.drives.set_outputs((VALVE * (number % 2), 0, 0))
        rig.cycles(1)
    rig.drives.reset()
    assert rig.cycles(300).fault is None
    assert rig.overlaps == []


@pytest.mark.parametrize("server", SERVERS)
@pytest.mark.generated(*range(8))
def test_the_end_of_the_service_takes_the_power_of_a_slow_drive(closing: Closing, server: str, seed: int) -> None:
    """It has left operational with power, and may be handling another request."""
    draw = random.Random(seed)
    rig = closing(SlowRig(draw.choice(TIMES), server, io=draw.choice((NO_IO, IO))))
    a = rig.devices[0]
    rig.ready()
    rig.slow()
    rig.enable()
    rig.cycles(20)
    a.objects[0x6007, 0].value = 0
    rig.leave(draw.choice((Nmt.PRE_OPERATIONAL, Nmt.STOPPED)))
    rig.cycles(draw.randrange(1, 130))
    rig.drives.close()
    for _ in range(round(3 * rig.seconds / STEP) + 1):
        rig.clock.now += STEP
        a.poll(rig.clock.now)
    assert a.state is PowerState.SWITCH_ON_DISABLED


def test_a_request_that_is_never_answered_is_forgotten(closing: Closing) -> None:
    """Controlwords by SDO to a drive that answers nothing do not follow each other faster than their answers may."""
    rig = closing(SlowRig(1e6, "keeps the first"))
    rig.ready()
    rig.slow()
    rig.enable()
    rig.devices[0].objects[0x6007, 0].value = 0
    rig.leave(Nmt.PRE_OPERATIONAL)
    rig.bus.sent.clear()
    rig.cycles(900)
    asked = rig.sent_to(canopen_frames.SDO_REQUEST)[0]
    assert asked[0] == STOPS[0]
    assert len(asked) <= 2 + 0.9 / ANSWER_TIME


@pytest.mark.parametrize("server", SERVERS)
@pytest.mark.generated(*range(8))
def test_a_set_up_that_is_interrupted_has_its_last_answer_awaited(closing: Closing, server: str, seed: int) -> None:
    """Another drive gets power by itself while a slow drive is being set up."""
    draw = random.Random(seed)
    rig = closing(SlowRig(draw.choice(TIMES[2:]), server))
    rig.ready()
    rig.slow()
    rig.cycles(20)
    rig.leave(Nmt.PRE_OPERATIONAL)
    rig.until(lambda _: rig.drives._is_being_configured(rig.drives._axes[0]), 0.3)
    rig.cycles(draw.randrange(200))
    rig.keep_power(1)
    rig.get_power(1)
    rig.devices[1]._publish()
    rig.cycles(300)
    assert not rig.drives._is_being_configured(rig.drives._axes[0])
    others = [data for _, data in rig.overlaps if data not in STOPS]
    # A queue holds the command to stop twice, and the answer to the first is taken for that to the second.
    assert len(others) <= (server == "queues")
    assert len(rig.overlaps) <= 3


@pytest.mark.parametrize("lost", [1, 4])
@pytest.mark.parametrize("switches", [False, True])
@pytest.mark.parametrize("when", range(0, 60, 7))
def test_a_few_lost_answers_of_a_drive_that_is_asked_for_its_statusword_are_no_fault(
    closing: Closing, when: int, switches: bool, lost: int
) -> None:
    """Answers to polls, also if an output is switched by SDO meanwhile."""
    rig = closing(SlowRig(0.0, "queues", io=IO))
    rig.enabled_within = 200
    rig.devices[0].objects[0x60FE, 1].mappable = False
    rig.ready()
    axis = rig.drives._axes[0]
    axis.exchange = replace(axis.exchange, polled=True)
    rig.devices[0].objects[0x1800, 1].value |= 1 << 31
    rig.devices[0]._route()
    rig.enable()
    rig.cycles(when)
    if switches:
        rig.drives.set_outputs((VALVE, 0, 0))
    rig.bus.faults.add(f"A drop sdo-answer for {lost} frames")
    rig.bus.sent.clear()
    assert rig.cycles(1000).fault is None
    assert (canopen_frames.SDO_REQUEST + rig.devices[0].node, canopen_frames.STATUSWORD_UPLOAD) in rig.bus.sent
    assert rig.devices[0].pins.bits == VALVE * switches
