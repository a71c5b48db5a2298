"""Set-ups of drives that others made, where an object is missing, refused, or another PDO has what is wanted."""

from __future__ import annotations

import pytest
from drivers.foreign import ENABLED, FAULT, Habits
from drivers.test_foreign import PERIOD, Rig
from rigs import OFF, Closing
from trirail_drivers.config import NO_IO, DigitalIo
from trirail_drivers.errors import DriveError

VALVE, LAMP, PART = 1 << 16, 1 << 17, 1 << 20
OUTPUT = DigitalIo(VALVE, 0, 0), *NO_IO[1:]
INPUT = DigitalIo(0, 0, PART), *NO_IO[1:]

FIXED = {
    (0x1600, 0): 1, (0x1600, 1): 0x6040_0010, (0x1601, 0): 1, (0x1601, 1): 0x607A_0020,
    (0x1A00, 0): 1, (0x1A00, 1): 0x6041_0010, (0x1A01, 0): 1, (0x1A01, 1): 0x6064_0020,
    (0x1402, 1): 0x8000_0401, (0x1802, 1): 0x8000_0381,
}  # fmt: skip
"""One object in each of the four PDOs that every drive needs; the next ones are off."""


def fifth(base: int, identifier: int, entry: int) -> tuple[tuple[int, int, int, str, int, bool], ...]:
    """Rows of a fifth PDO with one object and the identifier of the third, beyond those that the set-up maps."""
    at = base + 4
    return (
        (at, 1, 7, "ro", identifier, False),
        (at, 2, 5, "rw", 255, False),
        (at + 0x200, 0, 5, "ro", 1, False),
        (at + 0x200, 1, 7, "ro", entry, False),
    )


def fixed(*more: tuple[int, int, int, str, int, bool], values: dict[tuple[int, int], int] = FIXED) -> Habits:
    """Drives whose PDOs cannot be mapped, with more objects."""
    return Habits(fixed_pdos=True, values=values, more=more)


# ---------------------------------------------------------------------- PDOs that cannot be changed


def test_the_controlword_may_be_in_any_fixed_rpdo(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", fixed(*fifth(0x1400, 0x401, 0x6040_0010), values=FIXED | {(0x1600, 0): 0})))
    rig.ready()
    assert [axis.exchange.controlword for axis in rig.drives._axes] == [0x401, 0x402, 0x403]
    rig.enable()
    rig.go(0.05, 60)


def test_outputs_may_be_in_a_fixed_rpdo(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", fixed(*fifth(0x1400, 0x401, 0x60FE_0120)), io=OUTPUT))
    rig.ready()
    assert rig.drives.path_outputs[0]
    rig.enable()
    rig.drives.set_outputs((VALVE, 0, 0))
    rig.go(0.05, 10)
    assert rig.nodes[0].switched[-1][1] == VALVE
    assert rig.nodes[0].value(0x1404, 2) == 1, "at every SYNC"


def test_inputs_may_be_in_a_fixed_tpdo(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", fixed(*fifth(0x1800, 0x381, 0x60FD_0020)), io=INPUT))
    rig.ready()
    rig.enable()
    for pressed in (PART, 0):
        rig.nodes[0].put(0x60FD, pressed)
        rig.go(0.05, 3)
        assert rig.feedback.inputs[0] == pressed


def test_inputs_that_no_tpdo_takes_are_refused(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", fixed(), io=INPUT))
    with pytest.raises(DriveError, match=r"^drive A: its digital inputs 60FD cannot be mapped into a TPDO; use inputs"):
        rig.ready()


# ---------------------------------------------------------------------- outputs


def test_outputs_that_cannot_be_written_are_refused(closing: Closing) -> None:
    habits = Habits(values={(0x60FE, 1): VALVE}, refuses={(0x60FE, 1): lambda value: True})
    with pytest.raises(DriveError, match=r"^drive A: cannot write .* 60FE:01 .* needed for \[outputs\] of drive A"):
        closing(Rig("elmo_gold", habits, io=OUTPUT)).ready()


def test_safe_values_are_written_again_to_a_drive_that_takes_only_what_its_mask_enables(
    closing: Closing, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = closing(Rig("elmo_gold", io=(DigitalIo(VALVE | LAMP, LAMP, 0), *NO_IO[1:])))
    node = rig.nodes[0]
    node.put(0x60FE, VALVE, 1)
    store = node.local.set_data

    def store_enabled_bits(index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
        if (index, subindex) == (0x60FE, 1):
            held, mask = node.value(0x60FE, 1), node.value(0x60FE, 2)
            data = ((held & ~mask) | (int.from_bytes(data, "little") & mask)).to_bytes(4, "little")
        store(index, subindex, data, check_writable)

    monkeypatch.setattr(node.local, "set_data", store_enabled_bits)
    rig.ready()
    assert node.value(0x60FE, 1) == LAMP


# ---------------------------------------------------------------------- supervision, errors and modes


@pytest.mark.parametrize(("answers", "held"), [(True, (0, 100, 3)), (False, (100, 0, 0))])
def test_a_drive_uses_either_heartbeats_or_guarding(
    closing: Closing, answers: bool, held: tuple[int, int, int]
) -> None:
    habits = Habits(values={(0x1017, 0): 500}, answers_guarding=answers)
    rig = closing(Rig("technosoft_ipos", habits, accept_without=("1016",)))
    rig.ready()
    assert [node.value(0x1017) for node in rig.nodes] == [held[0]] * 3
    assert [(node.value(0x100C), node.value(0x100D)) for node in rig.nodes] == [held[1:]] * 3
    rig.enable()
    rig.go(0.05, 200)


def test_an_emcy_is_not_held_back(closing: Closing) -> None:
    rig = closing(Rig("ros2_cia402_slave", Habits(values={(0x1015, 0): 500})))
    rig.ready()
    assert [node.value(0x1015) for node in rig.nodes] == [0, 0, 0]


def test_a_buffer_of_setpoints_that_cannot_be_emptied_is_noted(closing: Closing) -> None:
    rig = closing(Rig("nanotec_pd4n", Habits(refuses={(0x60C4, 6): lambda value: True})))
    rig.ready()
    assert any("60C4:06" in warning and "it is refused" in warning for warning in rig.warnings)
    rig.enable()
    rig.go(0.05, 60)


@pytest.mark.parametrize(("index", "code"), [(0x1001, 0x7300), (0x603F, 0)])
def test_a_fault_at_the_start_is_known_also_if_its_cause_cannot_be_read(
    closing: Closing, index: int, code: int
) -> None:
    rig = closing(Rig("elmo_gold", Habits(access={(index, 0): "wo"})))
    for node in rig.nodes:
        node.state, node.error, node.register = FAULT, 0x7300, 0x21
    rig.drives.configure(PERIOD)
    fault = rig.cycle().fault
    assert fault is not None
    assert (fault.cause, fault.code) == ("fault", code)
    rig.drives.reset()
    feedback = rig.cycles(10)
    assert (feedback.fault, feedback.state) == (None, OFF)


def without_list_of_modes(**more: object) -> Habits:
    """A drive with both modes, which does not list them."""
    return Habits(without=frozenset({0x6502}), **more)  # type: ignore[arg-type]


def test_a_drive_that_does_not_list_its_modes_is_set_to_the_one_that_it_accepts(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", without_list_of_modes(refuses={(0x6060, 0): lambda value: value == 8})))
    rig.ready()
    assert {node.mode for node in rig.nodes} == {7}
    rig.enable()
    rig.go(0.05, 60)


def test_a_drive_that_lists_no_modes_and_shows_its_mode_only_with_power_is_set_to_the_better_one(
    closing: Closing, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = closing(Rig("elmo_gold", without_list_of_modes()))
    for node in rig.nodes:

        def put(index: int, value: int, subindex: int = 0, node: object = node, put: object = node.put) -> None:
            assert callable(put)
            put(index, 0 if index == 0x6061 and node.state != ENABLED else value, subindex)  # type: ignore[attr-defined]

        monkeypatch.setattr(node, "put", put)
    rig.ready()
    assert any("until it shows mode 8, with power" in warning for warning in rig.warnings)
    assert {node.mode for node in rig.nodes} == {8}
    rig.enable()
    rig.go(0.05, 60)


# ---------------------------------------------------------------------- power that stays on


@pytest.mark.parametrize("remote", [False, True])
def test_a_drive_that_keeps_its_power_under_local_control_says_so(
    closing: Closing, monkeypatch: pytest.MonkeyPatch, remote: bool
) -> None:
    """Bit 9 of the statusword (CiA 402-2): the drive does not process the controlword."""
    rig = closing(Rig("elmo_gold"))
    rig.ready()
    rig.enable()
    node, put = rig.nodes[1], rig.nodes[1].put
    monkeypatch.setattr(node, "control", lambda word: None)

    def put_local(index: int, value: int, subindex: int = 0) -> None:
        put(index, value & ~0x0200 if index == 0x6041 and not remote else value, subindex)

    monkeypatch.setattr(node, "put", put_local)
    rig.drives.disable()
    within = round(rig.config.stop_timeout / PERIOD) + 2
    fault = next(fault for _ in range(within) if (fault := rig.cycle(rig.target).fault) is not None)
    assert (fault.drive, fault.cause) == ("B", "timeout")
    assert ("it may be under local control: bit 9 (remote)" in fault.message) == (not remote)
