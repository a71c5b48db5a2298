"""What must stop drives that others made, in each of the ways that they are driven: strangers, and their own faults."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator

import can
import pytest
from drivers.foreign import DISABLED, ENABLED, OPERATIONAL, PRE_OPERATIONAL, QUICK_STOP, STOPPED, ForeignDrive, Habits
from drivers.test_foreign import MAKES, PERIOD, Rig
from msgspec import structs
from rigs import OFF, Closing, frame
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.codes import describe_error
from trirail_drivers.cia402.drives import Cia402
from trirail_drivers.config import Homing
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import PowerState
from trirail_drivers.timing import BusTiming

pytestmark = pytest.mark.long


WAYS: dict[str, tuple[str, Callable[[], Habits]]] = {
    "csp with offset, statusword on change": ("elmo_gold", Habits),
    "csp with offset, statusword beside the position": ("maxon_epos4_compact50_5", Habits),
    "csp without offset": ("ros2_cia402_slave", Habits),
    "interpolated position, two RPDOs, heartbeat": ("pilz_prbt", Habits),
    "interpolated position, node guarding": ("technosoft_ipos", Habits),
    "interpolated position, node guarding once it is set": (
        "technosoft_ipos", lambda: Habits(answers_unset_guarding=False),
    ),
    "statusword polled": (
        "elmo_gold",
        lambda: Habits(
            values={(0x1800, 1): 0x8000_0181, (0x1A01, 0): 1, (0x1A01, 1): 0x6064_0020, (0x1801, 2): 1},
            access=dict.fromkeys(
                [(0x1800, 1), *((0x1A00, n) for n in range(9)), *((0x1A01, n) for n in range(9))], "ro"
            ),
        ),
    ),
    "mappings that are fixed, controlword beside the setpoint": (
        "elmo_gold",
        lambda: Habits(
            fixed_pdos=True,
            values={
                (0x1400, 1): 0x8000_0201, (0x1600, 0): 0,
                (0x1601, 0): 2, (0x1601, 1): 0x6040_0010, (0x1601, 2): 0x607A_0020,
                (0x1A00, 0): 1, (0x1A01, 0): 2, (0x1A01, 1): 0x6041_0010, (0x1A01, 2): 0x6064_0020,
            },
        ),
    ),
}  # fmt: skip


@pytest.fixture(params=WAYS)
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    """Drives in motion."""
    make, habits = WAYS[request.param]
    rig = Rig(make, habits())
    rig.ready()
    rig.enable()
    rig.go(0.05, 60)
    yield rig
    rig.drives.close()


def stranger(rig: Rig) -> can.BusABC:
    """Another's place on the bus."""
    return can.Bus(rig.nodes[0].bus.channel_info.removeprefix("Virtual bus channel "), interface="virtual")


def stopped_within(rig: Rig, cycles: int) -> str:
    """Cycle with setpoints that go on, until there is a fault; all three drives must stop, whatever they hear."""
    for _ in range(cycles):
        rig.wires.sent.clear()
        feedback = rig.cycle(rig.target, (0.0, 0.0, 0.0))
        if feedback.fault is not None:
            break
    else:
        raise AssertionError(f"no fault within {cycles} cycles")
    rig.cycles(120, rig.target)
    assert [node.state for node in rig.nodes if node.state == ENABLED] == []
    assert [node.servo.velocity for node in rig.nodes] == [0.0] * 3
    return feedback.fault.message


def deaf(node: ForeignDrive, state: int) -> None:
    """Thrown out of operational, with nothing that would stop it: 6007h is not obeyed."""
    node.put(0x6007, 0)
    node.leave(state)


@pytest.mark.parametrize("state", [PRE_OPERATIONAL, STOPPED])
def test_a_drive_thrown_out_of_operational_is_told_by_sdo(rig: Rig, state: int) -> None:
    deaf(rig.nodes[1], state)
    # Its positions do not come: three SYNCs; its heartbeat tells within 0.1 s. Stopped, that alone says why it is deaf.
    said = stopped_within(rig, round(0.15 / PERIOD))
    assert said.startswith("drive B: ")


@pytest.mark.parametrize("command", [0x80, 0x02])
@pytest.mark.parametrize("node", [0, 2])
def test_nmt_by_a_stranger_stops_all_in_the_same_cycle(rig: Rig, command: int, node: int) -> None:
    for each in rig.nodes:
        each.put(0x6007, 0)
    with stranger(rig) as bus:
        bus.send(frame(0, bytes([command, node])))
        said = stopped_within(rig, 1)
    assert said.startswith("CAN bus: another master is on the bus and commands ")


@pytest.mark.parametrize(
    ("identifier", "data", "said"),
    [
        (0x080, b"", "sends SYNC"),
        (0x77E, b"\x05", "has this service's node id 126"),
        (None, bytes(8), "sends drive B PDOs"),
    ],
)
def test_two_masters_are_noticed(rig: Rig, identifier: int | None, data: bytes, said: str) -> None:
    way = rig.drives._axes[1].exchange
    with stranger(rig) as bus:
        if identifier is None:
            identifier, data = way.setpoints.identifier, bytes(way.setpoints.size)
            rig.nodes[1].bus.recv(0)
        bus.send(frame(identifier, data))
        assert said in stopped_within(rig, 1)


@pytest.mark.parametrize(
    ("request_data", "stops"),
    [
        (b"\x2b\x40\x60\x00\x06\x00\x00\x00", True),
        (b"\xc2\x10\x10\x01\x0e\x00\x00\x00", True),
        (b"\x40\x41\x60\x00\x00\x00\x00\x00", False),
        (b"\x60\x00\x00\x00\x00\x00\x00\x00", False),
    ],
)
def test_another_who_writes_to_a_drive_by_sdo_stops_all_and_who_reads_does_not(
    rig: Rig, request_data: bytes, stops: bool
) -> None:
    with stranger(rig) as bus:
        rig.wires.nodes.remove(rig.nodes[1])  # it does not answer
        bus.send(frame(0x600 + rig.drives._axes[1].node, request_data))
        feedback = rig.cycle(rig.target, (0.0, 0.0, 0.0))
    assert (feedback.fault is not None) == stops
    if feedback.fault is not None:
        assert "another master is on the bus and writes to drive B by SDO" in feedback.fault.message


@pytest.mark.parametrize("apart", [1, -40, 16_000_000])
def test_a_second_node_with_the_same_id_is_noticed(rig: Rig, apart: int) -> None:
    """Its slider may be anywhere: also beside this one [counts], as of a drive that was copied and not moved."""
    node, way = rig.nodes[2], rig.drives._axes[2].exchange
    pdo = next(index for index in node._pdos(0x1800) if node.value(index, 1) & 0x7FF == way.feedback.identifier)
    with stranger(rig) as bus:
        for _ in range(200):
            data = bytearray(node._packed(pdo))
            counts = node.value(0x6064)
            at = data.index(counts.to_bytes(4, "little", signed=True))
            data[at : at + 4] = (counts + apart).to_bytes(4, "little", signed=True)
            bus.send(frame(way.feedback.identifier, bytes(data)))
            feedback = rig.cycle(rig.target)
            if feedback.fault is not None:
                break
    assert feedback.fault is not None
    assert feedback.fault.message == (
        "drive C: a second node with id 3 on the bus: each SYNC has two positions; give each its own node id"
    )


def test_a_second_node_with_the_same_id_is_refused_by_the_set_up(closing: Closing) -> None:
    """What one is told by SDO both are told, and both answer."""
    rig = closing(Rig("elmo_gold"))
    first = rig.nodes[2]
    rig.wires.nodes.append(ForeignDrive("elmo_gold", first.node, stranger(rig), rig.clock, first.truth))
    with pytest.raises(DriveError, match="drive C: a second node with id 3 on the bus"):
        rig.ready()


@pytest.mark.parametrize("data", [b"\x00", b"\x7f"])
@pytest.mark.parametrize("after", [0, 7])
def test_a_second_node_that_is_plugged_in_is_named(rig: Rig, data: bytes, after: int) -> None:
    """It boots, or sends heartbeats of its own, while the drive goes on: all stop at once, and soon it is known why.

    After a boot-up message, the set-up of the drive is checked again: the drive itself may have booted.
    """
    for _ in range(after):
        rig.cycle(rig.target)
    with stranger(rig) as bus:
        bus.send(frame(0x702, data))
        assert stopped_within(rig, 1).startswith("drive B: ")
        assert "drive B: a second node with id 2 on the bus: one node has booted, or is not" in rig.last_fault(6)
    for _ in range(10_000):
        if rig.drives._axes[1].configured:
            break
        rig.cycle(rig.target)
    rig.drives.reset()
    assert rig.cycles(100).fault is None, "it has gone"


@pytest.mark.parametrize("in_flight", [False, True])
def test_a_drive_that_has_left_operational_is_no_second_one(rig: Rig, in_flight: bool) -> None:
    node, way = rig.nodes[1], rig.drives._axes[1].exchange
    pdo = next(index for index in node._pdos(0x1800) if node.value(index, 1) & 0x7FF == way.feedback.identifier)
    position = frame(way.feedback.identifier, node._packed(pdo))
    deaf(node, PRE_OPERATIONAL)
    with stranger(rig) as bus:
        bus.send(frame(0x702, b"\x7f"))
        if in_flight:
            bus.send(position)
        assert "left NMT operational" in stopped_within(rig, 1)
        assert "left NMT operational" in rig.last_fault(20)


def test_a_restart_is_noticed(rig: Rig) -> None:
    rig.nodes[0].boot()
    assert "drive A: has restarted" in stopped_within(rig, 1)


def test_a_drive_that_boots_within_a_cycle_and_starts_by_itself_is_configured_again(rig: Rig) -> None:
    """Its positions look like those of a second node, but it has lost its set-up."""
    node, window = rig.nodes[0], rig.nodes[0].value(0x6065)
    node.boot()
    node.nmt = OPERATIONAL
    assert node.value(0x6065) != window
    assert "drive A: " in stopped_within(rig, 1)
    for _ in range(10_000):
        rig.cycle(rig.target)
        if rig.drives._axes[0].configured:
            break
    assert rig.cycle(rig.target).unready[0] is None
    assert node.value(0x6065) == window


@pytest.mark.core
def test_a_drives_own_fault_stops_all(rig: Rig) -> None:
    rig.nodes[2].fail(0x4310)
    assert "drive C: emergency 0x4310 (drive too hot)" in stopped_within(rig, 2)
    rig.drives.reset()
    assert rig.cycles(100).fault is None
    assert [node.state for node in rig.nodes] == [DISABLED] * 3


def test_an_emcy_that_is_never_taken_back_does_not_block_reset(rig: Rig) -> None:
    rig.nodes[0].emergency(0x8210, register=0)
    assert "drive A: emergency 0x8210 (a PDO was too short to be used)" in stopped_within(rig, 2)
    rig.drives.reset()
    rig.feedback = rig.cycles(10)
    assert rig.feedback.fault is None
    rig.enable()


def test_an_emcy_that_is_still_in_force_does(rig: Rig) -> None:
    rig.nodes[0].register = 0x10
    rig.nodes[0].emergency(0x8130)
    stopped_within(rig, 2)
    rig.drives.reset()
    assert rig.last_fault(round(0.6 / PERIOD)) == f"drive A: emergency {describe_error(0x8130, ' is still in force')}"


def test_setpoints_that_are_not_followed_are_noticed(rig: Rig) -> None:
    rig.nodes[1].habits.has_bit_12 = False
    assert "drive B: does not follow setpoints" in stopped_within(rig, round(0.05 / PERIOD))


@pytest.mark.parametrize("option", [5, 6, 7, 8])
@pytest.mark.parametrize("way", [way for way, (make, _) in WAYS.items() if make != "pilz_prbt"])  # it lacks 605Ah
def test_a_drive_that_stays_in_quick_stop_active_loses_its_power_once_it_stands(
    closing: Closing, way: str, option: int
) -> None:
    """605Ah = 5 to 8, and read-only; power that were taken off before would let the slider coast."""
    make, habits = WAYS[way]
    made = habits()
    made.values[0x605A, 0] = option
    made.access[0x605A, 0] = "ro"
    lacking = (*MAKES[make].keys.get("accept_without", ()), "605A")
    rig = closing(Rig(make, made, accept_without=lacking))
    rig.ready()
    rig.enable()
    rig.go(0.05, 60)
    rig.drives.quick_stop()
    for _ in range(round(0.5 / PERIOD)):
        before = [(node.state, node.servo.velocity) for node in rig.nodes]
        rig.feedback = rig.cycle()
        assert rig.feedback.fault is None
        for node, (state, velocity) in zip(rig.nodes, before, strict=True):
            if node.state != state == QUICK_STOP:
                assert velocity == 0.0
    assert rig.feedback.state == OFF
    rig.enable()


def test_a_silent_drive_stops_the_others(rig: Rig) -> None:
    rig.wires.nodes.remove(node := rig.nodes[1])
    assert "drive B: no position for 3 cycles" in rig.last_fault(5)
    rig.cycles(100)
    assert all(each.state != ENABLED for each in rig.nodes)
    node.shutdown()


def test_drives_stop_by_themselves_when_the_service_is_gone(rig: Rig) -> None:
    """Those that have 6007h and a watch on the service: no frame comes any more."""
    for _ in range(400):
        rig.clock.now += PERIOD
        rig.wires.pump()
    for node in rig.nodes:
        assert node.nmt != OPERATIONAL or not node.has(0x6007)
        if node.has(0x6007):
            assert node.state == DISABLED


def test_a_drive_that_never_follows_is_not_enabled(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", Habits(has_bit_12=False)))
    rig.ready()
    rig.drives.enable()
    for _ in range(round(0.4 / PERIOD)):
        feedback = rig.cycle(rig.feedback.position)
        assert PowerState.OPERATION_ENABLED not in feedback.state
    assert feedback.fault is not None
    assert feedback.fault.message.endswith('if the drive never sets bit 12, set accept_without = ["6041"]')
    rig = closing(Rig("elmo_gold", Habits(has_bit_12=False), accept_without=("6041",)))
    rig.ready()
    rig.enable()
    rig.go(0.05, 20)


def test_each_way_is_what_its_name_says(closing: Closing) -> None:
    names = []
    for make, habits in WAYS.values():
        rig = closing(Rig(make, habits()))
        rig.ready()
        names.append(rig.drives._axes[0].exchange.name)
    assert names == [
        "cyclic synchronous position with velocity offset, statusword event-driven, heartbeat",
        "cyclic synchronous position with velocity offset, statusword with the position, heartbeat",
        "cyclic synchronous position, statusword event-driven, heartbeat",
        "interpolated position, statusword event-driven, heartbeat",
        "interpolated position, statusword event-driven, node guarding",
        "interpolated position, statusword event-driven, node guarding",
        "cyclic synchronous position with velocity offset, statusword polled, heartbeat",
        "cyclic synchronous position, statusword with the position, heartbeat",
    ]


def test_a_drive_whose_statusword_is_polled_is_asked_also_without_sync_and_setpoints(closing: Closing) -> None:
    """As the bench provokes its watchdog, which may act long after the time-out of the statusword."""
    make, habits = WAYS["statusword polled"]
    rig = Rig(make, habits())
    rig.drives = Cia402(rig.wires, BusTiming(1_000_000), structs.replace(rig.config, heartbeat=0.5), rig.clock)
    closing(rig).ready()
    rig.enable()
    feedback = rig.cycles(20, rig.target)
    for _ in range(round(2.0 / PERIOD)):
        rig.clock.now += PERIOD
        if (feedback := rig.drives.read()).fault is not None:
            break
    assert feedback.fault is not None
    assert feedback.fault.cause == "emcy", feedback.fault.message


@pytest.mark.parametrize("command", [0x42, 0x43])
def test_a_drive_that_pads_its_answers_is_heard_in_the_cycle_too(closing: Closing, command: int) -> None:
    """As in the set-up: four bytes for each value, with their number (43h) or without it (42h)."""
    make, habits = WAYS["statusword polled"]
    given = habits()
    given.tells_error_reset = False
    rig = closing(Rig(make, given))
    for node in rig.nodes:

        def padded(data: bytearray, answer: Callable[[bytes], None] = node.local.sdo.send_response) -> None:
            if data[0] >> 5 == 2 and data[0] & 0x02:
                data = bytearray([command, *data[1:]])
            answer(bytes(data))

        vars(node.local.sdo).update(send_response=padded)
    rig.ready()
    assert rig.drives._axes[0].exchange.polled
    assert rig.cycles(200).fault is None
    rig.enable()
    rig.go(0.05, 60)
    rig.nodes[0].emergency(0x4210, 0x09)
    rig.cycles(200)
    rig.drives.reset()
    assert rig.cycles(20).fault is None  # its error register tells that the error is over
    rig.enable()


def test_a_homing_that_the_bus_broke_off_leaves_the_statusword_polled(closing: Closing) -> None:
    """The request for the mode is refused, and no answer comes. Nothing else is requested while one is awaited."""
    make, habits = WAYS["statusword polled"]
    homing = Homing(method=19, speed_switch=0.05, speed_zero=0.01, acceleration=2.0)
    rig = closing(Rig(make, habits(), homing=homing))
    rig.ready()
    rig.enable()
    rig.drives.home()
    send = rig.wires.send
    vars(rig.wires).update(send=refused)
    assert rig.found("bus", 10).message.startswith("CAN bus: cannot send: ")
    vars(rig.wires).update(send=send)
    feedback = rig.cycles(200)
    assert PowerState.OPERATION_ENABLED not in feedback.state
    rig.drives.reset()
    assert rig.cycles(200).fault is None
    rig.drives.enable()
    assert rig.cycles(200).state == (PowerState.OPERATION_ENABLED,) * 3
    assert [node.mode for node in rig.nodes] == [8, 8, 8]


@pytest.mark.parametrize("phase", range(0, 20, 2))
def test_homing_waits_for_the_answer_to_a_poll(closing: Closing, phase: int) -> None:
    """A server handles one request at a time (CiA 301); these drives drop the next one until they have answered."""
    make, habits = WAYS["statusword polled"]
    homing = Homing(method=19, speed_switch=0.05, speed_zero=0.01, acceleration=2.0)
    rig = closing(Rig(make, habits(), homing=homing))
    rig.ready()
    rig.enable()
    a = rig.nodes[0]
    answer: Callable[[bytes], None] = a.local.sdo.send_response
    take: Callable[[int, bytearray, float], None] = a.local.sdo.on_request
    pump: Callable[[float], None] = a.pump
    answers: list[tuple[float, bytes]] = []

    def on_request(identifier: int, data: bytearray, timestamp: float) -> None:
        if not answers:
            take(identifier, data, timestamp)

    def pumped(wait: float = 0.0) -> None:
        if answers and rig.clock.now >= answers[0][0]:
            answer(answers.pop(0)[1])
        pump(wait)

    vars(a.local.sdo).update(
        send_response=lambda data: answers.append((rig.clock.now + 0.005, bytes(data))), on_request=on_request
    )
    vars(a).update(pump=pumped)
    rig.cycles(20 + phase // 2, rig.target)
    if phase == 0:  # an answer was lost
        rig.drives._axes[0].note_request(rig.clock.now, canopen_frames.STATUSWORD_UPLOAD)
    rig.drives.home()
    feedback = rig.cycles(300, rig.target)
    assert feedback.fault is None
    assert a.mode == 6


def refused(msg: can.Message, timeout: float | None = None) -> None:
    """Send nothing, since the queue is full."""
    raise can.CanOperationError("No buffer space available", errno.ENOBUFS)
