"""CANSimple messages against a DBC file, which cantools reads independently of this code."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest
from cantools.database.can import Database
from control_rig import CONFIG
from hypothesis import given
from hypothesis import strategies as st
from trirail_drivers.driver.row_updates import put_setpoint, scale_setpoint
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.odrive import cansimple
from trirail_drivers.odrive.axis import OdriveAxis
from trirail_drivers.timing import BusTiming, frame_bits

LOADED = cantools.database.load_file(Path(__file__).parents[1] / "data" / "odrive-cansimple.dbc")
assert isinstance(LOADED, Database)
DBC = LOADED
float32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
uint8 = st.integers(0, 0xFF)
uint32 = st.integers(0, 0xFFFFFFFF)


def encoded(name: str, **signals: object) -> bytes:
    return DBC.get_message_by_name(name).encode(signals, scaling=True)  # type: ignore[arg-type]


def decoded(name: str, data: bytes) -> Any:
    return DBC.get_message_by_name(name).decode(data, decode_choices=False)


@pytest.mark.parametrize("message", DBC.messages, ids=lambda message: message.name)
def test_numbers_are_those_of_the_dbc(message: Any) -> None:
    assert getattr(cansimple, message.name.upper()) == message.frame_id


@given(node=st.sampled_from(cansimple.NODES), number=st.integers(0, 31))
def test_identifiers_hold_six_bits_of_node_and_five_of_command(node: int, number: int) -> None:
    assert divmod(cansimple.identifier(node, number), 32) == (node, number)
    assert cansimple.identifier(node, number) < 1 << 11


def input_pos(position: float, velocity: float) -> bytes | None:
    """The data of Set_Input_Pos for turns and turns per second; None if they do not fit."""
    axis, data = OdriveAxis("A", 0, Scale(1.0, 0.0), CONFIG.drives), np.zeros(cansimple.INPUT_POS.size, np.uint8)
    if not scale_setpoint(axis, position, velocity):
        return None
    put_setpoint(axis, data)
    return data.tobytes()


@given(position=float32, velocity=st.floats(-cansimple.MAX_FEED_FORWARD, cansimple.MAX_FEED_FORWARD))
def test_set_input_pos(position: float, velocity: float) -> None:
    data = input_pos(position, velocity)
    assert data is not None
    said = decoded("Set_Input_Pos", data)
    assert said["Input_Pos"] == position
    assert said["Vel_FF"] == pytest.approx(velocity, abs=0.5001 * cansimple.VELOCITY_STEP)
    assert said["Torque_FF"] == 0.0
    assert data == encoded("Set_Input_Pos", Input_Pos=position, Vel_FF=said["Vel_FF"], Torque_FF=0.0)


@pytest.mark.parametrize("velocity", [32.768, -32.77, 1e9, float("inf"), float("nan")])
def test_feed_forward_beyond_16_bits_is_no_message(velocity: float) -> None:
    assert input_pos(0.0, velocity) is None


@pytest.mark.parametrize("position", [3.5e38, -3.5e38, float("inf"), float("nan")])
def test_a_position_beyond_32_bits_is_no_message(position: float) -> None:
    assert input_pos(position, 0.0) is None


def test_bytes_as_they_are_on_the_bus() -> None:
    assert (input_pos(-1.5, 2.0) or b"").hex() == "0000c0bfd0070000"
    assert cansimple.AXIS_STATE.pack(cansimple.AxisState.CLOSED_LOOP_CONTROL).hex() == "0800000000000000"
    assert cansimple.CONTROLLER_MODE.pack(cansimple.POSITION_CONTROL, cansimple.PASSTHROUGH).hex() == "0300000001000000"
    request = cansimple.request(3, cansimple.GET_ENCODER_ESTIMATES).message()
    assert (request.arbitration_id, request.is_remote_frame, request.dlc) == (0x069, True, 0)
    command = cansimple.command(3, cansimple.CLEAR_ERRORS, cansimple.CLEAR.pack(0)).message()
    assert command.equals(can.Message(arbitration_id=0x078, data=[0], is_extended_id=False), timestamp_delta=None)


@given(state=uint32, control=uint32, way=uint32)
def test_commands(state: int, control: int, way: int) -> None:
    assert cansimple.AXIS_STATE.pack(state) == encoded("Set_Axis_State", Axis_Requested_State=state)
    assert cansimple.CONTROLLER_MODE.pack(control, way) == encoded(
        "Set_Controller_Mode", Control_Mode=control, Input_Mode=way
    )


@given(error=uint32, state=uint8, result=uint8, done=st.integers(0, 1))
def test_heartbeat(error: int, state: int, result: int, done: int) -> None:
    signals = {"Axis_Error": error, "Axis_State": state, "Procedure_Result": result, "Trajectory_Done_Flag": done}
    assert cansimple.BEAT.unpack(encoded("Heartbeat", **signals)) == (error, state, result, done)


@given(active=uint32, reason=uint32, position=float32, velocity=float32, version=st.tuples(*[uint8] * 8))
def test_answers(active: int, reason: int, position: float, velocity: float, version: tuple[int, ...]) -> None:
    assert cansimple.ERRORS.unpack(encoded("Get_Error", Active_Errors=active, Disarm_Reason=reason)) == (active, reason)
    estimates = encoded("Get_Encoder_Estimates", Pos_Estimate=position, Vel_Estimate=velocity)
    assert cansimple.ESTIMATES.unpack(estimates) == (position, velocity)
    assert list(decoded("Get_Version", cansimple.VERSION.pack(*version)).values()) == list(version)


LATER = {
    "Axis_State": {15: "HARMONIC_CALIBRATION", 16: "HARMONIC_CALIBRATION_OF_THE_COMMUTATION_ENCODER"},
    "Axis_Error": {0x2_0000: "REQUESTED_CURRENT_TOO_HIGH"},
    "Procedure_Result": {16: "REQUESTED_CURRENT_TOO_HIGH"},
}
"""What firmware 0.6.11 has, by the enumerations of its odrivetool, and the maker's file has not yet."""


@pytest.mark.parametrize(
    ("signal", "names"),
    [
        ("Axis_Error", {int(error): error.name for error in cansimple.Error}),
        ("Procedure_Result", {int(result): result.name for result in cansimple.ProcedureResult}),
        (
            "Axis_State",
            {
                **{int(state): state.name for state in cansimple.AxisState},
                **{state: name.upper().replace(" ", "_") for state, name in cansimple.PROCEDURES.items()},
            },
        ),
    ],
)
def test_names_are_those_of_the_dbc(signal: str, names: dict[int, str]) -> None:
    choices = DBC.get_message_by_name("Heartbeat").get_signal_by_name(signal).choices
    assert choices is not None
    assert names == {value: str(name) for value, name in choices.items()} | LATER[signal]


def test_errors_in_words() -> None:
    assert cansimple.error_names(0x0100_0200) == "DC_BUS_UNDER_VOLTAGE, WATCHDOG_TIMER_EXPIRED"
    assert cansimple.error_names(0x8000_0001) == "INITIALIZING, unknown error 80000000"
    assert cansimple.state_name(8) == "closed loop control"
    assert cansimple.state_name(77) == "axis state 77"


def test_bus_load_counts_what_passes_in_a_second() -> None:
    setpoint, request, answer, heartbeat = frame_bits(8), frame_bits(0), frame_bits(8), frame_bits(8)
    bits = 1000 * 3 * (setpoint + request + answer) + 100 * (request + answer) + 3 * 10 * heartbeat
    assert cansimple.TRAFFIC.bus_load(1000.0, BusTiming(1_000_000), 0.1) == pytest.approx(bits / 1e6)
    assert 0.99 < bits / 1e6 < 1.0


@given(bitrate=st.integers(125_000, 1_000_000), heartbeat=st.floats(0.01, 1.0))
def test_highest_rate_fills_the_bus(bitrate: int, heartbeat: float) -> None:
    rate = cansimple.TRAFFIC.highest_rate(BusTiming(bitrate), heartbeat)
    assert cansimple.TRAFFIC.bus_load(rate, BusTiming(bitrate), heartbeat) == pytest.approx(1.0)
