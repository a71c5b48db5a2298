"""Two ODrives with one node id: the set-up refuses them, and the cycle stops the robot and names the id."""

from __future__ import annotations

import random
from collections.abc import Callable

import can
import pytest
from drivers.test_odrive import CONFIG, Rig
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec import structs
from rigs import Closing
from trirail_drivers.driver.duplicate_node import FAR_APART_M, FAR_SYNCS
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES
from trirail_drivers.odrive import cansimple
from trirail_drivers.odrive.flat_endpoints import Version
from trirail_drivers.simulated import SimulatedOdrive
from trirail_drivers.simulated.odrive import CAN

NO_ADDRESS = Version((5, 2, 0), (0, 6, 8))
"""A firmware without the message Address."""


def plug_in(rig: Rig, index: int, apart: float, *, first: bool = False) -> SimulatedOdrive:
    """Connect a drive with the node id of another one; its slider is `apart` metres beside the other slider.

    It sends its frames before those of the other drive if it is `first`.
    """
    drive, other = rig.config.each[index], rig.devices[index]
    twin = rig.device(drive, other.servo.position + apart * drive.counts_per_metre)
    twin.version, twin.serial = other.version, other.serial + 1
    twin.connect(rig.bus.inject, rig.clock())
    send, receive = rig.bus.send, rig.bus._recv_internal

    def hear(message: can.Message) -> None:
        if message.is_remote_frame:
            twin.receive_remote(message.arbitration_id, rig.clock())
        else:
            twin.receive(message.arbitration_id, bytes(message.data), rig.clock())

    def send_to_both(message: can.Message, timeout: float | None = None) -> None:
        if first:
            hear(message)
        send(message, timeout)
        if not first:
            hear(message)

    def receive_from_both(timeout: float | None) -> tuple[can.Message | None, bool]:
        twin.poll(rig.clock())
        return receive(timeout)

    rig.bus.send = send_to_both  # type: ignore[assignment, method-assign]
    rig.bus._recv_internal = receive_from_both  # type: ignore[method-assign]
    return twin


def noisy(device: SimulatedOdrive, noise: Callable[[], float]) -> Callable[[int], None]:
    """Return the drive's function that answers a command, with noise in the position."""
    answer = device._answer

    def answer_with_noise(command: int) -> None:
        if command == cansimple.GET_ENCODER_ESTIMATES:
            turns = device.servo.position - device._zero + noise()
            device._send(command, cansimple.ESTIMATES.pack(turns, device.servo.velocity))
        else:
            answer(command)

    return answer_with_noise


TURNS = CONFIG.A.counts_per_metre
INDEX = st.integers(0, 2)
APART = st.floats(-0.1, 0.1)
ORDER = st.booleans()


@settings(max_examples=20)
@example(index=0, apart=0.0, first=True)
@given(index=INDEX, apart=APART, first=ORDER)
def test_set_up_refuses_a_second_drive_with_another_serial_number(index: int, apart: float, first: bool) -> None:
    rig = Rig()
    plug_in(rig, index, apart, first=first)
    node = rig.config.each[index].node
    try:
        with pytest.raises(
            DriveError, match=rf"^drive {NAMES[index]}: a second node with id {node} on the bus: serial"
        ):
            rig.ready()
        assert not any(device.power.name == "OPERATION_ENABLED" for device in rig.devices)
    finally:
        rig.drives.close()


@pytest.mark.parametrize("first", [False, True])
def test_set_up_refuses_a_second_drive_with_another_firmware(closing: Closing, first: bool) -> None:
    rig = closing(Rig())
    plug_in(rig, 1, 0.02, first=first).version = NO_ADDRESS
    with pytest.raises(
        DriveError, match=r"^drive B: a second node with id 7 on the bus: firmware .* and firmware .* answer"
    ):
        rig.ready()


@pytest.mark.parametrize("firmware", [(0, 6, 8), (0, 6, 10)])
def test_an_answer_that_arrives_twice_is_no_second_drive(closing: Closing, firmware: tuple[int, int, int]) -> None:
    rig = closing(Rig())
    for device in rig.devices:
        device.version = Version((5, 2, 0), firmware)
    rig.bus.faults.add("all duplicate")
    rig.ready()
    assert rig.cycles(300).fault is None


@settings(max_examples=30)
@example(index=0, apart=0.05, first=True, later=False)
@given(index=INDEX, apart=APART.filter(lambda apart: abs(apart) > 1.01 * FAR_APART_M), first=ORDER, later=st.booleans())
def test_two_far_positions_for_each_request_are_a_fault(index: int, apart: float, first: bool, later: bool) -> None:
    """The second drive is there from the start, with a firmware that reports no serial number, or comes later."""
    rig = Rig()
    try:
        if later:
            rig.ready()
            rig.cycles(10)
        else:
            for device in rig.devices:
                device.version = NO_ADDRESS
        plug_in(rig, index, apart, first=first)
        if not later:
            rig.ready()
        fault = rig.found("frame", within=FAR_SYNCS + 1)
        node = rig.config.each[index].node
        assert fault.message == (
            f"drive {NAMES[index]}: a second node with id {node} on the bus: each request has two positions; "
            "give each its own node id"
        )
    finally:
        rig.drives.close()


@settings(max_examples=10)
@example(period_ms=1, noise=0.02, seed=0)
@given(period_ms=st.integers(1, 10), noise=st.floats(0.0, 0.02), seed=st.integers(0, 99))
def test_positions_that_come_unasked_show_no_second_drive(period_ms: int, noise: float, seed: int) -> None:
    """Where `accept_without` permits cyclic messages, several positions `noise` metres apart may answer one request."""
    each = {name: structs.replace(getattr(CONFIG, name), accept_without=("cyclic_messages",)) for name in NAMES}
    rig, chance = Rig(structs.replace(CONFIG, **each)), random.Random(seed)
    try:
        for device in rig.devices:
            device.settings[f"{CAN}.encoder_msg_rate_ms"] = period_ms
            vars(device).update(_answer=noisy(device, lambda: chance.gauss(0.0, noise * TURNS)))
        rig.ready()
        assert rig.cycles(1000).fault is None
    finally:
        rig.drives.close()


def test_a_firmware_without_the_message_address_is_not_sent_its_command(closing: Closing) -> None:
    """There it sets the node id."""
    rig = closing(Rig())
    for device in rig.devices:
        device.version = NO_ADDRESS
    before = [device.node for device in rig.devices]
    rig.ready()
    assert rig.cycles(200).fault is None
    assert [device.node for device in rig.devices] == before


def test_the_command_of_address_sets_the_node_id_of_older_firmware(closing: Closing) -> None:
    device = closing(Rig()).devices[1]
    device.version = NO_ADDRESS
    device.receive(cansimple.identifier(device.node, cansimple.ADDRESS), (5).to_bytes(4, "little"), 0.0)
    assert device.node == 5
