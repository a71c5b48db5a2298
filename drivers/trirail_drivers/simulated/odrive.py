"""Simulated ODrive on CANSimple with its axis, without a thread."""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Callable
from typing import Final

from trirail_drivers.interface import PowerState
from trirail_drivers.odrive import cansimple
from trirail_drivers.odrive.cansimple import AxisState, Error, ProcedureResult
from trirail_drivers.odrive.flat_endpoints import KNOWN_TABLES, Version
from trirail_drivers.odrive.protections import ABSOLUTE_SETPOINTS, POSITION_STATUS, RELATIVE_MODE
from trirail_drivers.simulated.servo import Servo

HARDWARE: Final = (4, 4, 58)
FIRMWARE: Final = (0, 6, 10)
CAN: Final = "axis0.config.can"
VELOCITY_CONTROL: Final = 2
NO_TIMEOUT: Final = float("inf")
BOOT: Final = 0.25
"""Time for which a restarted drive reports that it is initialising [s]."""

_CYCLIC: Final = {
    "version": cansimple.GET_VERSION,
    "encoder": cansimple.GET_ENCODER_ESTIMATES,
    "error": cansimple.GET_ERROR,
}
_SENT_CYCLIC: Final = tuple(
    (name, f"{CAN}.{name}_msg_rate_ms", command)
    for name, command in (("heartbeat", cansimple.HEARTBEAT), *_CYCLIC.items())
)
"""Cyclic messages that are sent: name, setting with the period [ms], and command number."""
_UNSENT_CYCLIC: Final = ("iq", "temperature", "bus_voltage", "torques", "powers")
"""Other cyclic messages. Their settings are stored and reported, but they are not sent, since no client reads them."""
_REQUESTS: Final = (
    cansimple.GET_VERSION,
    cansimple.GET_ERROR,
    cansimple.ADDRESS,
    cansimple.GET_ENCODER_ESTIMATES,
)


def _discard(can_id: int, data: bytes) -> None:
    """Drop a frame from a device that is not on a bus."""


class SimulatedOdrive:
    """Simulated ODrive axis. Its owner passes frames and the time to it by calling `receive` and `poll`.

    The axis moves with time and follows each setpoint as soon as it arrives. A disarmed axis coasts, since it has no
    brake; `friction` [turns/s²] brings it to rest. The watchdog disarms the axis after `watchdog` seconds without a
    message. The axis sends heartbeats and the cyclic messages that its settings enable.
    """

    def __init__(
        self, node: int, servo: Servo, *, heartbeat: float, friction: float, watchdog: float = NO_TIMEOUT
    ) -> None:
        self.node = node
        self.servo = servo
        self.axis_state = AxisState.IDLE
        self.errors = Error(0)
        """Active errors."""
        self.disarm_reason = Error(0)
        self.result = ProcedureResult.SUCCESS
        self.calibrated = True
        """Whether the axis is calibrated. An axis that is not calibrated refuses closed-loop control."""
        self.silent = False
        """Whether the wire is cut: the drive receives and sends nothing, but keeps running."""
        self.modes = (VELOCITY_CONTROL, cansimple.PASSTHROUGH)
        """Control mode and input mode. The initial modes are wrong, as if another client had set them."""
        self.version = Version(HARDWARE, FIRMWARE)
        self.tables = KNOWN_TABLES
        """Tables of endpoint numbers, among which is that of the drive's firmware."""
        self.serial = 0x3664_0000_0000 + node
        self.settings: dict[str, float] = {
            "axis0.config.enable_watchdog": watchdog < NO_TIMEOUT,
            "axis0.config.watchdog_timeout": watchdog if watchdog < NO_TIMEOUT else 0.0,
            f"{CAN}.input_vel_scale": 1000,
            f"{CAN}.heartbeat_msg_rate_ms": round(1000 * heartbeat),
            **{f"{CAN}.{name}_msg_rate_ms": 0 for name in (*_CYCLIC, *_UNSENT_CYCLIC)},
            POSITION_STATUS: 0,
            ABSOLUTE_SETPOINTS: True,
        }
        """Settings by path. Their endpoint numbers are those of the drive's firmware."""
        self._input = (servo.position, 0.0)
        """Position and velocity of the servo that were commanded last."""
        self._zero = 0.0
        """Position of the servo at which the drive reports 0."""
        self._friction = friction
        self._fed = self._moved_at = 0.0
        self._booted = NO_TIMEOUT
        self._due: dict[str, float] = {}
        """Time at which each cyclic message is due [s]."""
        self._transmit: Callable[[int, bytes], None] = _discard
        self._handlers: dict[int, Callable[[bytes], None]] = {
            cansimple.ESTOP: self._estop,
            cansimple.SET_AXIS_STATE: self._set_state,
            cansimple.SET_CONTROLLER_MODE: self._set_mode,
            cansimple.SET_INPUT_POS: self._set_input,
            cansimple.CLEAR_ERRORS: self._clear,
            cansimple.RX_SDO: self._sdo,
        }

    @property
    def state(self) -> str:
        """Axis state and disarm reason, for people."""
        name = cansimple.state_name(self.axis_state)
        return f"{name}, {cansimple.error_names(self.disarm_reason)}" if self.disarm_reason else name

    @property
    def power(self) -> PowerState:
        """State of CiA 402 that corresponds to the axis state and the errors."""
        if self._armed:
            return PowerState.OPERATION_ENABLED
        return PowerState.FAULT if self._error_bits else PowerState.SWITCH_ON_DISABLED

    @property
    def emergencies(self) -> None:
        """None, since CANSimple has no EMCY."""
        return None

    def connect(self, transmit: Callable[[int, bytes], None], now: float) -> None:
        """Connect the drive to a bus and switch the drive on at time `now` [s].

        The drive sends each frame by calling `transmit(can_id, data)`.
        """
        self._transmit = transmit
        self._moved_at = now
        self._due = dict.fromkeys(("heartbeat", *_CYCLIC), now)

    def receive(self, can_id: int, data: bytes, now: float) -> None:
        """Receive a data frame at time `now` [s].

        An empty frame is also a request; a frame of the wrong length is ignored.
        """
        node, command = divmod(can_id, 1 << 5)
        if node != self.node or self.silent:
            return
        self.poll(now)  # work that was due before the frame arrived
        self._fed = now
        if command == cansimple.ADDRESS and self.version.firmware < cansimple.ADDRESS_FIRMWARE:
            self.node = int.from_bytes(data[:4], "little")  # Set_Axis_Node_ID; a remote frame sets 0
        elif command in _REQUESTS:
            if not data:
                self._answer(command)
        elif command in self._handlers:
            with contextlib.suppress(struct.error):
                self._handlers[command](data)

    def receive_remote(self, can_id: int, now: float) -> None:
        """Receive a remote frame at time `now` [s]."""
        self.receive(can_id, b"", now)

    def poll(self, now: float) -> None:
        """Do the work due at time `now` [s]."""
        if now > self._moved_at:
            self._move(now - self._moved_at)
            self._moved_at = now
        if now >= self._booted:
            self._booted = NO_TIMEOUT
            self.axis_state, self.errors = AxisState.IDLE, Error(0)
        watchdog = self.settings["axis0.config.watchdog_timeout"]
        if self._armed and self.settings["axis0.config.enable_watchdog"] and now >= self._fed + watchdog:
            self.fail(Error.WATCHDOG_TIMER_EXPIRED)
        for name, setting, command in _SENT_CYCLIC:
            if now >= self._due[name] and (period := self.settings[setting] / 1000.0):
                self._answer(command)
                self._due[name] += period
                if self._due[name] <= now:  # the next message is overdue as well, so it is skipped
                    self._due[name] = now + period

    @property
    def pins(self) -> None:
        """None, since CANSimple has no message for the GPIO pins."""
        return None

    def press(self, switches: int) -> None:
        """Do nothing, since CANSimple does not report switches."""

    def fail(self, errors: int) -> None:
        """Report the given errors, and disarm the axis."""
        self.errors |= Error(errors)
        if self._armed:
            self.disarm_reason |= Error(errors)
            self.result = ProcedureResult.DISARMED
            self.axis_state = AxisState.IDLE

    def restart(self, now: float) -> None:
        """Cycle the power supply: the drive restarts in idle and loses its modes and errors.

        A drive whose position is relative then counts from the present place.
        """
        if self.settings[POSITION_STATUS] == RELATIVE_MODE or not self.settings[ABSOLUTE_SETPOINTS]:
            self._zero = self.servo.position
        self.axis_state, self.modes = AxisState.UNDEFINED, (VELOCITY_CONTROL, cansimple.PASSTHROUGH)
        self.errors, self.disarm_reason, self.result = Error.INITIALIZING, Error(0), ProcedureResult.SUCCESS
        self._booted = now + BOOT

    @property
    def _armed(self) -> bool:
        return self.axis_state is AxisState.CLOSED_LOOP_CONTROL

    @property
    def _error_bits(self) -> int:
        return self.errors | self.disarm_reason

    def _move(self, step: float) -> None:
        if not self._armed:
            self.servo.roll(self._friction, step)
        elif self.modes == (cansimple.POSITION_CONTROL, cansimple.PASSTHROUGH):
            self.servo.chase(*self._input, step)

    def _answer(self, command: int) -> None:
        if command == cansimple.HEARTBEAT:
            data = cansimple.BEAT.pack(self._error_bits, self.axis_state, self.result, 0)
        elif command == cansimple.GET_VERSION:
            data = cansimple.VERSION.pack(2, *self.version.hardware, *self.version.firmware, self.version.unreleased)
        elif command == cansimple.ADDRESS:
            data = bytes([self.node]) + self.serial.to_bytes(6, "little") + b"\0"
        elif command == cansimple.GET_ERROR:
            data = cansimple.ERRORS.pack(self.errors, self.disarm_reason)
        else:
            data = cansimple.ESTIMATES.pack(self.servo.position - self._zero, self.servo.velocity)
        self._send(command, data)

    def _sdo(self, data: bytes) -> None:
        """Read or write a setting (RxSdo). There is no answer to endpoint numbers of other firmware versions."""
        opcode, number, _ = cansimple.SDO.unpack_from(data)
        table = next((table.endpoints for table in self.tables if table.matches(self.version)), {})
        for path, endpoint in table.items():
            if endpoint.id != number or path not in self.settings:
                continue
            kind = cansimple.TYPES[endpoint.type]
            if opcode == cansimple.WRITE:
                (self.settings[path],) = kind.unpack_from(data, cansimple.SDO.size)
            else:
                value = self.settings[path]
                data = kind.pack(value if endpoint.type in {"float", "bool"} else int(value))
                self._send(cansimple.TX_SDO, cansimple.SDO.pack(0, number, 0) + data)

    def _estop(self, _data: bytes) -> None:
        self.fail(Error.ESTOP_REQUESTED)

    def _set_state(self, data: bytes) -> None:
        (state,) = cansimple.AXIS_STATE.unpack(data)
        if self.axis_state is AxisState.UNDEFINED:
            return
        if state == AxisState.IDLE:
            self.axis_state = AxisState.IDLE
        elif state == AxisState.CLOSED_LOOP_CONTROL and not self._armed:
            if self.errors:
                self.result = ProcedureResult.DISARMED
            elif not self.calibrated:
                self.result = ProcedureResult.NOT_CALIBRATED
            else:
                self.result, self.axis_state = ProcedureResult.SUCCESS, AxisState.CLOSED_LOOP_CONTROL
                self.disarm_reason = Error(0)
                # Hold the current position at first (axis.cpp of the firmware's published source).
                self._input = self.servo.position, 0.0

    def _set_mode(self, data: bytes) -> None:
        control, way = cansimple.CONTROLLER_MODE.unpack(data)
        self.modes = control, way

    def _set_input(self, data: bytes) -> None:
        position, velocity, _ = cansimple.INPUT_POS.unpack(data)
        if math.isfinite(position):
            self._input = position + self._zero, velocity / self.settings[f"{CAN}.input_vel_scale"]
        else:
            self.fail(Error.MISSING_INPUT)

    def _clear(self, data: bytes) -> None:
        cansimple.CLEAR.unpack(data)
        self.errors &= Error.INITIALIZING
        self.disarm_reason = Error(0)

    def _send(self, command: int, data: bytes) -> None:
        if not self.silent:
            self._transmit(cansimple.identifier(self.node, command), data)
