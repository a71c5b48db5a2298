"""Error codes of drives in words: the standards' tables, ODrive's, and what is in none of them."""

from __future__ import annotations

import re

import canopen.emcy
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail_drivers.cia402.axis import Cia402Axis
from trirail_drivers.cia402.canopen_frames import EMERGENCY
from trirail_drivers.cia402.codes import describe_error
from trirail_drivers.config import Drive, Drives
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.errors import MAX_MESSAGE_LENGTH
from trirail_drivers.odrive import codes as odrive
from trirail_drivers.odrive.cansimple import Error

SUPPLY = "check the supply; braking feeds energy back into it"


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (0x8140, "0x8140 (back from bus-off); check cable, terminators and bitrate: trirail doctor"),
        (0x7305, "0x7305 (incremental encoder 1); check the encoder and its cable"),
        (0x3210, f"0x3210 (DC link overvoltage); {SUPPLY}"),
        (0x231F, "0x231F (current of the motor); check motor, cable and load"),
        (0x2A00, "0x2A00 (current); check motor, cable and load"),
        (0x9123, "0x9123 (external error); check the wiring of the drive's inputs"),
        (0xFF07, "0xFF07 (manufacturer-specific); see the drive's manual"),
        (0xB000, "0xB000 (of no class of CiA 301); see the drive's manual"),
    ],
)
def test_a_code_is_said_in_words(code: int, said: str) -> None:
    assert describe_error(code) == said


@given(st.integers(0, 0xFFFF))
def test_every_code_has_its_number_a_meaning_and_a_remedy(code: int) -> None:
    assert re.fullmatch(rf"0x{code:04X} \([^()]+\); \S.*", describe_error(code))


@given(st.integers(0x1000, 0xFFFF))
def test_every_class_that_the_canopen_library_knows_is_known(code: int) -> None:
    known = str(canopen.emcy.EmcyError(code, 0, b"", 0.0).get_desc())
    assert ("of no class" not in describe_error(code)) or not known


@given(st.integers(0x0100, 0xFFFF), st.integers(0, 0xFF), st.binary(min_size=5, max_size=5))
def test_a_drives_emergency_is_one_line_whatever_its_code(code: int, register: int, more: bytes) -> None:
    each = Drive(1, 1e6)
    axis = Cia402Axis("B", 2, Scale(1e6, 0.0), Drives("cia402", each, each, each))
    axis.on_emergency(EMERGENCY.pack(code, register, more), 0.0)
    assert axis.event is not None
    said = axis.event.message
    assert axis.event.code == code
    assert said.startswith(f"drive B: emergency 0x{code:04X} (")
    assert f"), error register 0x{register:02X}; " in said
    assert said.isprintable()
    assert len(said) <= MAX_MESSAGE_LENGTH


@given(st.integers(1, 0xFFFF_FFFF))
def test_every_error_of_an_odrive_has_its_name_a_meaning_and_a_remedy(errors: int) -> None:
    said = odrive.describe_errors(errors)
    assert re.fullmatch(rf"0x{errors:08X} .+\(.+\); \S.*", said)
    assert all((f"{error.name} (" in said) == bool(errors & error) for error in Error)
    assert said.isprintable()


def test_errors_of_an_odrive_that_call_for_the_same_are_answered_once() -> None:
    hot = odrive.describe_errors(Error.MOTOR_OVER_TEMP | Error.INVERTER_OVER_TEMP | 1 << 31)
    assert hot == (
        "0x80006000 MOTOR_OVER_TEMP (motor too hot), INVERTER_OVER_TEMP (power stage too hot), 80000000h (of a "
        "firmware that is not known here); let it cool down; check load and airflow; see the drive's manual"
    )
