"""Error frames, and frames that cannot be sent, in words."""

from __future__ import annotations

import errno
import re

import can
import pytest
from trirail_drivers.bus.canerrors import BUS_OFF, Severity, decode_error_frame, error_number, explain, queue_is_full
from trirail_drivers.driver.conversations import receive
from trirail_drivers.errors import BusError


@pytest.mark.parametrize(
    ("kind", "data", "severity", "said"),
    [
        (0x001, (), Severity.WARNING, "a frame was not sent in time"),
        (0x002, (5,), Severity.ROUTINE, "arbitration lost"),
        (0x004, (0, 0x01), Severity.WARNING, "receive buffer overflow"),
        (0x004, (0, 0x08), Severity.WARNING, "error-warning: 96 transmit errors"),
        (0x204, (0, 0x10), Severity.WARNING, "error-passive: 128 receive errors"),
        (0x204, (0, 0x30), Severity.WARNING, "128 receive errors.*; error-passive: 128 transmit errors"),
        (0x204, (0, 0x40), Severity.ROUTINE, "error-active again"),
        (0x004, (), Severity.WARNING, "controller problem"),
        (0x088, (0, 0, 0x84, 0x0A), Severity.WARNING, "bit stuffing error in sending at the data"),
        (0x008, (0, 0, 0x00, 0x19), Severity.WARNING, "protocol violation at the acknowledgement slot"),
        (0x010, (0, 0, 0, 0, 0x70), Severity.WARNING, "transceiver: CANL shorted to ground"),
        (0x020, (), Severity.WARNING, "no acknowledgement from any other node"),
        (0x040, (), Severity.FAULT, r"bus-off: .*ip link set can3 down, ip link set can3 up"),
        (0x244, (0, 0x20), Severity.FAULT, "bus-off.*error-passive"),
        (0x100, (), Severity.WARNING, "restarted after bus-off"),
    ],
)
def test_error_frames_in_words(kind: int, data: tuple[int, ...], severity: Severity, said: str) -> None:
    told = decode_error_frame(kind, bytes(data).ljust(8, b"\0"), "socketcan channel 'can3', captured")
    assert told.severity is severity
    assert "\n" not in told.text
    assert re.search(said, told.text)


def test_an_error_frame_of_another_interface_is_not_read_as_socketcans() -> None:
    told = decode_error_frame(0x040, bytes(4), "can3")
    assert told.severity is Severity.WARNING
    assert "own coding" in told.text


def refused(number: int | None) -> can.CanOperationError:
    return can.CanOperationError("Failed to transmit", number)


def caused(number: int) -> can.CanOperationError:
    error = can.CanOperationError("cannot send")
    error.__cause__ = OSError(number, "why")
    return error


@pytest.mark.parametrize(
    ("error", "full", "remedy"),
    [
        (refused(errno.ENOBUFS), True, "no node acknowledges.*txqueuelen"),
        (can.CanOperationError("Transmit buffer full"), True, "txqueuelen"),
        (caused(errno.EAGAIN), True, "txqueuelen"),
        (OSError(errno.ENOBUFS, "No buffer space available"), True, "txqueuelen"),
        (refused(errno.ENETDOWN), False, "is down; bring it up: ip link set can3 up"),
        (refused(errno.ENODEV), False, "no longer exists; check that the adapter"),
        (caused(errno.EPIPE), False, "the listening end of the bus has closed"),
        (caused(errno.EIO), False, "^cannot send$"),
    ],
)
def test_why_a_frame_could_not_be_sent(error: Exception, full: bool, remedy: str) -> None:
    assert queue_is_full(error) is full
    assert re.search(remedy, explain(error, "can3"))
    assert explain(error, "socketcan channel 'can3'") == explain(error, "can3")
    assert "set can3" in explain(error, "can3") or "ip link" not in explain(error, "can3")


def test_the_systems_number_is_found_behind_what_it_caused() -> None:
    assert error_number(caused(errno.EPIPE)) == errno.EPIPE
    assert error_number(ValueError("no number")) is None


def test_a_bus_that_is_off_before_the_cycle_runs_is_named_in_the_remedy() -> None:
    with can.Bus("off", interface="virtual") as bus:
        bus.channel_info = "socketcan channel 'can3'"
        with can.Bus("off", interface="virtual") as controller:
            controller.send(can.Message(arbitration_id=BUS_OFF, is_error_frame=True, data=bytes(8)))
        with pytest.raises(BusError, match=r"bus-off: .*: ip link set can3 down, ip link set can3 up$"):
            receive(bus, 0.0)
