"""Digital outputs and inputs of CiA 402 drives: set-up, frames, inputs, recovery, refusals, and drives of others."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator
from itertools import groupby

import can
import msgspec
import pytest
from canopen import SdoAbortedError
from drivers.foreign import Habits
from drivers.test_cia402 import CONFIG, Rig
from drivers.test_foreign import MAKES
from drivers.test_foreign import Rig as ForeignRig
from rigs import STANDSTILL, STEP, Closing
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.inspection import inspect
from trirail_drivers.cia402.one_drive import HAS_POWER
from trirail_drivers.config import NO_IO, DigitalIo
from trirail_drivers.driver.axis_row import AxisRow
from trirail_drivers.driver.row_updates import OUTPUT_REPEATS, note_outputs, outputs_pending
from trirail_drivers.errors import BusError, DriveError
from trirail_drivers.simulated.device import Nmt
from trirail_drivers.simulated.dictionary import UNSUPPORTED_ACCESS
from trirail_drivers.simulated.faultlines import FaultSyntaxError

VALVE, LAMP, PART = 1 << 16, 1 << 17, 1 << 20
IO = DigitalIo(VALVE | LAMP, LAMP, 0), DigitalIo(0, 0, PART), DigitalIo()
"""Two outputs of A, of which one is on where it is safe; an input of B."""


@pytest.fixture
def rig() -> Iterator[Rig]:
    """Drives as they were switched on."""
    made = Rig(io=IO)
    yield made
    made.drives.close()


def outputs_sent(rig: Rig) -> list[list[int]]:
    """What each drive was sent by its frame of outputs since the record was cleared, without repetitions."""
    sent = [[canopen_frames.OUTPUTS.unpack(data)[0] for data in each] for each in rig.sent_to(canopen_frames.RPDO3)]
    return [[word for word, _ in groupby(each)] for each in sent]


def by_sdo(rig: Rig, index: int) -> list[int]:
    """What a drive was sent by SDO."""
    each = rig.sent_to(canopen_frames.SDO_REQUEST)[index]
    return [int.from_bytes(data[4:], "little") for data in each if data[:4] == canopen_frames.OUTPUTS_DOWNLOAD]


def ready(rig: Rig) -> Rig:
    """Set up, with the outputs sent, also for the last time."""
    rig.ready()
    rig.cycles(1 + OUTPUT_REPEATS)
    rig.bus.sent.clear()
    return rig


# ---------------------------------------------------------------------- set-up


def test_a_set_up_makes_outputs_safe_and_allows_no_others(rig: Rig) -> None:
    rig.devices[0].objects[0x60FE, 1].write(VALVE)
    rig.devices[0].objects[0x60FE, 2].write(VALVE | 1)
    rig.ready()
    a, b, c = rig.devices
    assert [a.objects[0x60FE, sub].value for sub in (1, 2)] == [LAMP, VALVE | LAMP]
    assert a.pins.bits == LAMP
    assert [a.objects[key].value for key in ((0x1402, 1), (0x1402, 2), (0x1602, 0), (0x1602, 1))] == [
        0x400 + a.node, 1, 1, 0x60FE0120,
    ]  # fmt: skip
    assert [b.objects[0x1A00, sub].value for sub in range(3)] == [2, 0x60410010, 0x60FD0020]
    assert rig.drives.path_outputs == (True, False, False)
    for other in (b, c):
        assert other.objects[0x60FE, 2].value == 0
        assert other.objects[0x1402, 1].value >> 31


def test_without_outputs_and_inputs_the_bus_is_as_ever() -> None:
    plain, none = Rig(), Rig(io=NO_IO)
    for each in (plain, none):
        each.drives.configure(STEP)
        each.cycles(20)
        each.drives.close()
    assert plain.bus.sent == none.bus.sent
    assert not any(0x60FE.to_bytes(2, "little") == data[1:3] for _, data in plain.bus.sent if len(data) == 8)
    assert not any(can_id >> 7 == canopen_frames.RPDO3 >> 7 for can_id, _ in plain.bus.sent)


def test_a_bit_that_the_maker_reserves_is_refused_by_name(rig: Rig) -> None:
    rig.bus.faults.add("A reserves 17")
    rig.bus.faults.poll(rig.clock.now)
    with pytest.raises(
        DriveError,
        match=r"^drive A: object 60FE:02 .* stays 00010000h, expected 00030000h: the manufacturer reserves bit 17; use",
    ):
        rig.drives.configure(STEP)


@pytest.mark.parametrize(("io", "lacks"), [(IO[0], 0x60FE), (IO[1], 0x60FD)])
def test_a_drive_without_them_is_refused_by_the_object(io: DigitalIo, lacks: int) -> None:
    name = f"{lacks:04X}"
    rig = ForeignRig("elmo_gold", Habits(without=frozenset((lacks,))), io=(DigitalIo(), io, DigitalIo()))
    with pytest.raises(DriveError, match=rf"^drive B: lacks object {name}:0\d \(Digital .*, needed for digital"):
        rig.ready()
    rig.drives.close()


def test_a_survey_shows_the_changes_and_writes_nothing(rig: Rig) -> None:
    found = inspect(rig.bus, CONFIG, STEP, rig.clock, apply=False, io=IO)
    objects = {difference["object"] for difference in found[0]["differences"]}
    assert {"60FE:01", "60FE:02", "1402:01", "1602:01"} <= objects
    assert {"1A00:02"} <= {difference["object"] for difference in found[1]["differences"]}
    assert [rig.devices[0].objects[0x60FE, sub].value for sub in (1, 2)] == [0, 0]


def test_three_drives_of_outputs_do_not_fit_at_a_full_bus() -> None:
    each = DigitalIo(VALVE)
    loads = []
    config = msgspec.structs.replace(CONFIG, velocity_offset="always")
    for io in (NO_IO, (each, *NO_IO[1:]), (each, each, NO_IO[0])):
        rig = Rig(config, io=io)
        rig.drives.configure(STEP)
        loads.append(rig.drives.bus_load)
        rig.drives.close()
    frame = (8 * 4 + 47 + (34 + 8 * 4 - 1) // 4) * 1000 / 1e6
    assert [load - loads[0] for load in loads] == pytest.approx([0.0, frame, 2 * frame])
    rig = Rig(config, io=(each, each, each))
    with pytest.raises(BusError, match=r"1000 Hz takes 103% of the bus .* highest rate that fits is 9"):
        rig.drives.configure(STEP)
    rig.drives.close()


# ---------------------------------------------------------------------- the cycle


def test_an_output_switches_at_the_sync_of_the_setpoint_it_was_written_with(rig: Rig) -> None:
    ready(rig)
    a = rig.devices[0]
    before = a.syncs
    assert rig.drives.path_outputs[0]
    rig.drives.set_outputs((VALVE, 0, 0))
    rig.cycle()
    assert a.pins.bits == LAMP
    rig.cycles(3)
    assert outputs_sent(rig) == [[VALVE], [], []]
    change = a.pins.history[-1]
    assert (change.sync, change.bits) == (before + 2, VALVE)
    assert change.time == pytest.approx(rig.clock.now - 2 * STEP)
    assert change.position == a.servo.position


@pytest.mark.parametrize("lost", range(OUTPUT_REPEATS + 1))
def test_outputs_are_repeated_since_a_frame_may_be_lost(rig: Rig, lost: int) -> None:
    """In some cycles, and then no longer."""
    device = ready(rig).devices[0]
    rig.drives.set_outputs((VALVE, 0, 0))
    if lost:
        rig.bus.faults.add(f"A drop rpdo3 for {lost} frames")
    rig.cycles(OUTPUT_REPEATS + 3)
    assert device.pins.bits == VALVE
    assert rig.sent_to(canopen_frames.RPDO3)[0] == [canopen_frames.OUTPUTS.pack(VALVE)] * (1 + OUTPUT_REPEATS)


@pytest.mark.parametrize("cycles", range(3, 8))
def test_outputs_reach_a_drive_that_hears_nothing_for_fewer_cycles_than_are_a_fault(cycles: int) -> None:
    rig = Rig(msgspec.structs.replace(CONFIG, missed_positions=10), IO)
    try:
        device = ready(rig).devices[0]
        device.silent = True
        rig.drives.set_outputs((VALVE, 0, 0))
        rig.cycles(cycles)
        device.silent = False
        rig.cycles(OUTPUT_REPEATS + 3)
        assert device.pins.bits == VALVE
        rig.bus.sent.clear()
        rig.cycles(5)
        assert outputs_sent(rig) == [[], [], []]
    finally:
        rig.drives.close()


@pytest.mark.parametrize("behind", [(0, 1), (1, 0), (0,), (1,), (0, 0, 1)])
def test_outputs_are_repeated_no_longer_where_answers_come_now_before_the_setpoints_and_now_behind(
    behind: tuple[int, ...],
) -> None:
    row = AxisRow(has_outputs=True, outputs=VALVE)
    sent = 0
    for _, late in zip(range(100), itertools.cycle(behind), strict=False):
        row.syncs += 1
        row.sampled, row.prompt = row.syncs - late, not late
        if outputs_pending(row):
            note_outputs(row)
            sent += 1
    assert sent == 1 + OUTPUT_REPEATS


def test_only_named_bits_are_ever_sent(rig: Rig) -> None:
    ready(rig)
    rig.drives.set_outputs((0xFFFF_FFFF, 0xFFFF_FFFF, 1))
    rig.cycles(3)
    assert outputs_sent(rig) == [[VALVE | LAMP], [], []]


def test_outputs_are_sent_behind_setpoints_and_also_in_the_cycle_of_a_stop(rig: Rig) -> None:
    ready(rig)
    rig.enable()
    rig.bus.sent.clear()
    rig.drives.set_outputs((VALVE | LAMP, 0, 0))
    rig.cycle()
    identifiers = [can_id for can_id, _ in rig.bus.sent]
    assert identifiers.index(canopen_frames.RPDO3 + 1) > identifiers.index(canopen_frames.RPDO2 + 9)
    rig.clock.now += STEP
    rig.drives.sync()
    feedback = rig.drives.read()
    rig.bus.sent.clear()
    rig.drives.quick_stop()
    rig.drives.set_outputs((LAMP, 0, 0))
    rig.drives.write(feedback.position, STANDSTILL)
    assert outputs_sent(rig) == [[LAMP], [], []]
    assert not any(can_id >> 7 == canopen_frames.RPDO2 >> 7 for can_id, _ in rig.bus.sent)


def test_outputs_that_a_full_bus_refuses_are_sent_in_the_next_cycle(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    ready(rig)
    send, refused = rig.bus.send, itertools.count()

    def full(message: can.Message, timeout: float | None = None) -> None:
        if message.arbitration_id == canopen_frames.RPDO3 + 1 and next(refused) < 1:
            raise can.CanOperationError("Transmit buffer full")
        send(message, timeout)

    monkeypatch.setattr(rig.bus, "send", full)
    rig.drives.set_outputs((VALVE, 0, 0))
    rig.cycle()
    assert outputs_sent(rig) == [[], [], []]
    rig.cycle()
    rig.cycle()
    assert outputs_sent(rig) == [[VALVE], [], []]
    assert rig.devices[0].pins.bits == VALVE


def switched_on(rig: Rig) -> Rig:
    """With power, and an output that is on where it is not safe."""
    ready(rig)
    rig.enable()
    rig.drives.set_outputs((VALVE, 0, 0))
    rig.cycles(5)
    assert rig.devices[0].pins.bits == VALVE
    return rig


def test_the_end_of_the_service_makes_outputs_safe(rig: Rig) -> None:
    switched_on(rig).drives.close()
    assert rig.devices[0].pins.bits == LAMP


@pytest.mark.parametrize("power", [False, True])
@pytest.mark.parametrize("cycles", [0, 1, 5, 300])
@pytest.mark.parametrize("nmt", [Nmt.STOPPED, Nmt.PRE_OPERATIONAL])
def test_the_end_of_the_service_makes_outputs_safe_in_every_nmt_state(
    rig: Rig, nmt: Nmt, cycles: int, power: bool
) -> None:
    """The drive may have left NMT operational just before, so that no heartbeat has shown it yet."""
    switched_on(rig)
    if not power:
        rig.drives.disable()
        rig.cycles(20)
    rig.devices[0]._enter(nmt)
    for _ in range(cycles):
        rig.cycle()
    rig.drives.close()
    assert rig.devices[0].pins.bits == LAMP
    assert rig.devices[0].state not in HAS_POWER


def test_an_output_sticks_on_demand(rig: Rig) -> None:
    ready(rig)
    rig.bus.faults.add("A output-stuck 17 for 0.01")
    rig.cycle()
    rig.drives.set_outputs((VALVE, 0, 0))
    rig.cycles(4)
    assert rig.devices[0].pins.bits == VALVE | LAMP
    rig.cycles(20)
    assert rig.devices[0].pins.bits == VALVE


# ---------------------------------------------------------------------- inputs


def test_inputs_come_masked_with_the_statusword(rig: Rig) -> None:
    rig.bus.press(1, PART | 1)
    rig.ready()
    assert rig.cycle().inputs == (0, PART, 0)
    rig.bus.press(1, 1)
    assert rig.cycles(2).inputs == (0, 0, 0)
    rig.bus.press(2, PART)
    assert rig.cycles(2).inputs == (0, 0, 0), "C has no inputs that the robot uses"


@pytest.mark.parametrize("before", [0, PART])
@pytest.mark.parametrize("reads", ["cycle", "observe"])
def test_a_pulse_of_an_input_that_is_shorter_than_a_cycle_has_two_edges(rig: Rig, before: int, reads: str) -> None:
    rig.bus.press(1, before)
    ready(rig)
    rig.cycles(3)
    for pressed in (PART - before, before):
        rig.bus.press(1, pressed)
        rig.bus._exchange.poll(rig.clock.now)  # the drive sends its PDO
    seen = [(rig.cycle() if reads == "cycle" else rig.drives.observe()).inputs[1] for _ in range(4)]
    assert seen in ([PART - before, before, before, before], [before, PART - before, before, before])


def test_an_input_that_bounces_has_more_edges_than_one(rig: Rig) -> None:
    ready(rig)
    rig.bus.faults.add("B input-bounces 20")
    rig.cycle()
    rig.bus.press(1, PART)
    seen = [rig.cycle().inputs[1] for _ in range(20)]
    edges = sum(one != other for one, other in itertools.pairwise([0, *seen]))
    assert edges > 2
    assert seen[-10:] == [PART] * 10


def test_an_odrive_has_no_such_faults() -> None:
    from drivers.test_odrive import Rig as OdriveRig

    rig = OdriveRig()
    with pytest.raises(FaultSyntaxError, match="drive A has no digital inputs"):
        rig.bus.faults.add("A output-stuck 16")
    assert rig.drives.path_outputs == (False, False, False)
    rig.drives.set_outputs((0, 0, 0))
    rig.drives.close()


# ---------------------------------------------------------------------- drives that take outputs by SDO


def unmappable(rig: Rig, index: int = 0) -> None:
    """Let a drive refuse 60FEh:01 in a PDO."""
    rig.devices[index].objects[0x60FE, 1].mappable = False


def test_outputs_that_no_pdo_takes_go_by_sdo_and_not_on_a_path(rig: Rig) -> None:
    unmappable(rig)
    rig.ready()
    assert rig.drives.path_outputs == (False, False, False)
    warnings = [warning for _ in range(3) for warning in rig.cycle().warnings]
    assert any("written by SDO, since no RPDO takes 60FE:01" in warning for warning in warnings)
    rig.bus.sent.clear()
    rig.drives.set_outputs((VALVE, 0, 0))
    rig.cycles(5)
    assert outputs_sent(rig) == [[], [], []]
    assert by_sdo(rig, 0) == [VALVE]
    assert rig.devices[0].pins.bits == VALVE
    # Faster than the drive answers, it is asked for one at a time, and the newest is the last.
    for word in (0, LAMP, VALVE | LAMP):
        rig.drives.set_outputs((word, 0, 0))
        rig.cycle()
    rig.cycles(3)
    assert by_sdo(rig, 0)[-1] == VALVE | LAMP
    assert rig.devices[0].pins.bits == VALVE | LAMP


def test_compiled_cycles_wait_for_outputs_by_sdo(rig: Rig) -> None:
    unmappable(rig)
    ready(rig)
    rig.enable()
    rig.cycles(20)
    assert rig.drives.prepare_tables()
    rig.drives.set_outputs((VALVE, 0, 0))
    assert not rig.drives.prepare_tables()
    rig.cycles(3)
    assert rig.drives.prepare_tables()


def test_a_drive_that_refuses_its_outputs_later_is_a_fault(rig: Rig) -> None:
    unmappable(rig)
    ready(rig)

    def refuse(_entry: object, _old: int) -> None:
        raise SdoAbortedError(UNSUPPORTED_ACCESS)

    rig.devices[0].objects.on_write(0x60FE, refuse)
    rig.drives.set_outputs((VALVE, 0, 0))
    assert "refuses its digital outputs, object 60FE:01 (SDO abort 06010000)" in rig.found("state", 5).message


# ---------------------------------------------------------------------- recovery


@pytest.mark.parametrize("wanted", [LAMP, VALVE])
@pytest.mark.parametrize("mapped", [True, False])
def test_a_drive_that_lost_its_supply_gets_its_outputs_again(rig: Rig, mapped: bool, wanted: int) -> None:
    """The safe value, as the control wants with a fault; or that of an output which may stay on."""
    if not mapped:
        unmappable(rig)
    ready(rig)
    a = rig.devices[0]
    rig.drives.set_outputs((VALVE, 0, 0))
    rig.cycles(5)
    assert a.pins.bits == VALVE
    a.restart(rig.clock.now)
    assert a.pins.bits == 0
    rig.drives.set_outputs((wanted, 0, 0))
    for _ in range(8000):
        if rig.cycle().unready == (None, None, None):
            break
    assert rig.drives.path_outputs[0] is mapped
    rig.cycles(5)
    assert a.objects[0x60FE, 2].value == VALVE | LAMP
    assert a.pins.bits == wanted
    assert LAMP in [change.bits for change in list(a.pins.history)[-2:]], "safe as long as it was set up"
    rig.drives.reset()
    rig.cycles(5)
    rig.drives.set_outputs((VALVE | LAMP, 0, 0))
    rig.cycles(5)
    assert a.pins.bits == VALVE | LAMP


# ---------------------------------------------------------------------- drives that others made

OF_MAKES = {name: name != "pilz_prbt" for name in MAKES if name != "ros2_cia402_slave"}
"""Makes with outputs, and whether one of their RPDOs is left for them."""


@pytest.mark.parametrize("name", OF_MAKES)
def test_outputs_of_others_switch_in_their_cycle(closing: Closing, name: str) -> None:
    """canopen's LocalNode over makers' dictionaries: each cycle's word at the next SYNC, inputs as they change."""
    chance = random.Random(name)
    io = DigitalIo(VALVE | LAMP, LAMP, PART)
    habits = Habits(values={(0x60FD, 0): 0})  # what an EDS without a default leaves to the drive
    rig = closing(ForeignRig(name, habits, io=(io, io, io)))
    rig.ready()
    assert set(rig.drives.path_outputs) == {OF_MAKES[name]}
    assert {node.value(0x60FE, 1) & io.outputs for node in rig.nodes} == {LAMP}
    if rig.nodes[0].has(0x60FE, 2):
        assert {node.value(0x60FE, 2) for node in rig.nodes} == {io.outputs}
    rig.enable()
    written = [(LAMP, LAMP, LAMP)] * 2
    for _ in range(200):
        if not OF_MAKES[name] and len(written) % 10:
            words = written[-1]
        else:
            a, b, c = (chance.choice((0, VALVE, LAMP, VALVE | LAMP)) for _ in range(3))
            words = a, b, c
        rig.drives.set_outputs(words)
        inputs = [chance.choice((0, PART, PART | 1)) for _ in range(3)]
        for node, value in zip(rig.nodes, inputs, strict=True):
            node.put(0x60FD, value)
        rig.feedback = rig.cycle(rig.target)
        assert rig.feedback.fault is None, rig.feedback.fault
        held = tuple(node.value(0x60FE, 1) & io.outputs for node in rig.nodes)
        if OF_MAKES[name]:
            assert held == written[-1], "taken up at the SYNC of this cycle"
        written.append(words)
    rig.cycles(3, rig.target)
    assert tuple(node.value(0x60FE, 1) & io.outputs for node in rig.nodes) == written[-1]
    assert rig.cycle(rig.target).inputs == tuple(value & PART for value in inputs)
    kept = [node.value(0x60FE, 1) & ~io.outputs & -rig.nodes[0].has(0x60FE, 2) for node in rig.nodes]
    assert kept == [0, 0, 0]


def test_a_drive_without_a_mask_keeps_its_other_bits(closing: Closing) -> None:
    io = DigitalIo(VALVE, 0, 0)
    rig = closing(ForeignRig("maxon_epos4_compact50_5", Habits(values={(0x60FE, 1): 0x0004_0001}), io=(io, *NO_IO[1:])))
    rig.ready()
    rig.drives.set_outputs((VALVE, 0, 0))
    rig.cycles(3, rig.feedback.position)
    assert rig.nodes[0].value(0x60FE, 1) == 0x0005_0001


def test_a_slave_without_60fe_is_refused_by_name(closing: Closing) -> None:
    rig = closing(ForeignRig("ros2_cia402_slave", io=(NO_IO[0], DigitalIo(VALVE), NO_IO[0])))
    with pytest.raises(DriveError, match=r"^drive B: lacks object 60FE:01"):
        rig.ready()


def test_inputs_have_a_pdo_of_their_own_where_the_statusword_has_none(closing: Closing) -> None:
    """An inhibit time that cannot be set: the statusword comes with the position."""
    habits = Habits(values={(0x1800, 3): 1000}, access={(0x1800, 3): "ro"})
    rig = closing(ForeignRig("elmo_gold", habits, io=(DigitalIo(inputs=PART), *NO_IO[1:])))
    rig.ready()
    exchange = rig.drives._axes[0].exchange
    assert exchange.status is None
    assert exchange.inputs == canopen_frames.TPDO3 + 1
    rig.nodes[0].put(0x60FD, PART | 1)
    rig.feedback = rig.cycle(rig.feedback.position)
    assert rig.cycle(rig.feedback.position).inputs == (PART, 0, 0)


LATE_INPUTS = {
    "inhibit time": {(0x1800, 3): 1000, (0x1802, 3): 1000},
    "event timer of their own PDO": {(0x1800, 3): 1000, (0x1802, 5): 0},
    "event timer of the statusword's PDO": {(0x1800, 5): 0},
}
"""Values that a drive keeps, with which its inputs come late, or a lost frame of theirs is not repeated."""


def with_inputs(values: dict[tuple[int, int], int]) -> ForeignRig:
    """Drives that keep these values, of which A has an input that the robot uses."""
    return ForeignRig(
        "elmo_gold", Habits(values=values, access=dict.fromkeys(values, "ro")), io=(DigitalIo(inputs=PART), *NO_IO[1:])
    )


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("case", LATE_INPUTS)
def test_inputs_whose_pdo_is_late_or_not_repeated_are_requested_by_sdo(
    closing: Closing, monkeypatch: pytest.MonkeyPatch, case: str, lost: bool
) -> None:
    """No edge is lost, also where every frame of their PDO is."""
    rig = closing(with_inputs(LATE_INPUTS[case]))
    rig.ready()
    a = rig.nodes[0]
    identifier, send = rig.drives._axes[0].exchange.inputs, a._send
    monkeypatch.setattr(a, "_send", lambda can_id, data: None if lost and can_id == identifier else send(can_id, data))
    longest = round(canopen_frames.POLL_PERIOD / rig.period) + 3
    for pressed in (PART, 0) * 10:
        a.put(0x60FD, pressed)
        seen = [rig.cycle(rig.feedback.position) for _ in range(longest)]
        assert seen[-1].fault is None, seen[-1].fault
        assert seen[-1].inputs[0] == pressed
        edges = [one.inputs[0] != other.inputs[0] for one, other in itertools.pairwise(seen)]
        assert sum(edges) <= 1
    assert not rig.drives.prepare_tables(), "compiled cycles send no requests"


@pytest.mark.parametrize("case", LATE_INPUTS)
def test_the_log_says_how_late_inputs_may_be_and_what_to_set(closing: Closing, case: str) -> None:
    rig = closing(with_inputs(LATE_INPUTS[case]))
    rig.ready()
    (told,) = [warning for warning in rig.warnings if "digital inputs" in warning]
    index = 0x1800 if (0x1800, 5) in LATE_INPUTS[case] else 0x1802
    assert "may be 20 ms late" in told
    assert "also requested by SDO" in told
    assert f"{index:04X}:03" in told
    assert not any("statusword" in warning and "1802" in warning for warning in rig.warnings)


def test_inputs_with_a_short_inhibit_time_are_not_requested_by_sdo(closing: Closing) -> None:
    rig = closing(with_inputs({(0x1800, 3): 50, (0x1802, 3): 50}))
    rig.ready()
    (told,) = [warning for warning in rig.warnings if "digital inputs" in warning]
    assert "may be 5 ms late" in told
    assert "SDO" not in told
    rig.cycles(50, rig.feedback.position)
    assert not any(message.data[1:3] == b"\xfd\x60" for message in rig.wires.sent[-150:])


def test_an_answer_by_sdo_does_not_replace_inputs_that_a_pdo_has_brought_since_it_was_requested(
    closing: Closing,
) -> None:
    rig = closing(with_inputs(LATE_INPUTS["inhibit time"]))
    rig.ready()
    axis, now = rig.drives._axes[0], rig.clock.now
    answer = b"\x43\xfd\x60\x00" + bytes(4)
    axis.note_request(now, canopen_frames.INPUTS_UPLOAD)
    axis.on_inputs(canopen_frames.INPUTS.pack(PART), now)
    axis.on_sdo(answer, now)
    axis.update_inputs()
    assert axis.inputs == PART
    axis.note_feedback()
    axis.note_request(now, canopen_frames.INPUTS_UPLOAD)
    axis.on_sdo(answer, now)
    axis.update_inputs()
    assert axis.inputs == 0


def test_inputs_whose_request_the_drive_refuses_are_not_requested_in_every_cycle(closing: Closing) -> None:
    rig = closing(with_inputs(LATE_INPUTS["inhibit time"]))
    rig.ready()
    axis, now = rig.drives._axes[0], rig.clock.now
    axis.note_request(now, canopen_frames.INPUTS_UPLOAD)
    axis.on_sdo(b"\x80\xfd\x60\x00" + bytes(4), now)
    assert axis.inputs_due == now + canopen_frames.POLL_PERIOD


# ---------------------------------------------------------------------- drives that miss outputs


@pytest.mark.parametrize("state", [Nmt.PRE_OPERATIONAL, Nmt.STOPPED])
@pytest.mark.parametrize("mapped", [True, False])
def test_a_drive_that_has_left_operational_gets_its_safe_outputs(rig: Rig, mapped: bool, state: Nmt) -> None:
    """It receives no PDO, so they come by SDO as the commands to stop do, and do not wait for a new set-up."""
    if not mapped:
        unmappable(rig)
    a = switched_on(rig).devices[0]
    a._enter(state)
    rig.found("silent", 5)
    rig.drives.set_outputs((LAMP, 0, 0))  # the heartbeat that tells of the state is up to 0.1 s away
    cycles = 0
    while a.pins.bits != LAMP:
        rig.cycle()
        cycles += 1
    assert cycles < (110 if state is Nmt.PRE_OPERATIONAL else 700)  # a stopped node may miss the first request
    assert not any(rig.cycles(800).unready)
    assert a.pins.bits == LAMP
    rig.drives.reset()
    rig.drives.set_outputs((VALVE | LAMP, 0, 0))
    rig.cycles(5)
    assert a.pins.bits == VALVE | LAMP


@pytest.mark.parametrize("when", ["before the cut", "after the fault"])
@pytest.mark.parametrize("mapped", [True, False])
def test_a_drive_that_was_cut_off_for_some_cycles_gets_its_outputs(rig: Rig, mapped: bool, when: str) -> None:
    """The other nodes acknowledge what it misses. It is back before its set-up would be checked again."""
    if not mapped:
        unmappable(rig)
    a = switched_on(rig).devices[0]
    a.silent = True
    if when == "before the cut":  # the drive answers no SYNC any more, which is not known in this cycle
        rig.drives.set_outputs((LAMP, 0, 0))
    rig.found("silent", 5)
    rig.drives.set_outputs((LAMP, 0, 0))
    rig.cycles(20)
    a.silent = False
    rig.cycles(3 if mapped else 600)
    assert a.pins.bits == LAMP
    rig.bus.sent.clear()
    rig.cycles(50)
    assert outputs_sent(rig) == [[], [], []]
    assert by_sdo(rig, 0) == []


def test_outputs_by_sdo_go_on_after_an_answer_was_lost(rig: Rig) -> None:
    unmappable(rig)
    a = switched_on(rig).devices[0]
    rig.bus.faults.add("A drop sdo-answer")
    rig.drives.set_outputs((LAMP, 0, 0))
    rig.cycle()
    rig.bus.faults.clear()
    rig.drives.set_outputs((VALVE, 0, 0))
    rig.cycles(400)
    assert a.pins.bits == LAMP  # the answer may still come: a server handles one request at a time
    rig.cycles(200)
    assert a.pins.bits == VALVE
    rig.drives.set_outputs((LAMP, 0, 0))
    rig.cycles(600)
    assert a.pins.bits == LAMP
