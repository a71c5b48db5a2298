"""CiA 402 objects of a simulated drive, with their values converted to counts and seconds."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from canopen import SdoAbortedError

from trirail_drivers.simulated.dictionary import INVALID_VALUE, Dictionary, ObjectEntry
from trirail_drivers.simulated.factor_group import FactorGroup, Mechanics
from trirail_drivers.simulated.homing import EDGES, STANDING
from trirail_drivers.simulated.servo import Servo

TECHNOSOFT: Final = 0x1A3
NANOTEC: Final = 0x26C
LINEAR: Final = 1 << 8
"""Bit 8 of Technosoft's auxiliary settings register 208Eh, which selects linear interpolation."""
_MILLISECONDS: Final = -3


class MakersRules:
    """Deviations of some manufacturers from CiA 402. Drives of all other manufacturers do not deviate."""

    def __init__(self, objects: Dictionary) -> None:
        vendor = objects.internal(0x1018, 1).value
        self._technosoft = vendor == TECHNOSOFT
        self._auxiliary = objects.internal(0x208E, 0)
        if vendor == NANOTEC:
            objects.on_write(0x60C2, _in_milliseconds)

    @property
    def interpolates_linearly(self) -> bool:
        """Whether mode 7 follows 60C1h:01 as defined in CiA 402.

        Source: Technosoft, iPOS CANopen Programming (P091.063), section 9.2.1, as quoted in issues 198 and 222 of
        roboticslab-uc3m/yarp-devices. Bit 8 of 208Eh selects linear interpolation without a buffer. Otherwise, 60C0h =
        0 selects PT mode, which buffers points with their time in 60C1h:02, so that a position alone has no effect.
        """
        return not self._technosoft or bool(self._auxiliary.value & LINEAR)

    @property
    def shows_mode_with_power_alone(self) -> bool:
        """Whether 6061h shows the mode that was written to 6060h only in OPERATION ENABLED.

        Source: Technosoft, the same manual of 2019, 6061h, as quoted in issue 215 of yarp-devices.
        """
        return self._technosoft


def _in_milliseconds(entry: ObjectEntry, _old: int) -> None:
    """Refuse every exponent except -3, milliseconds (Nanotec, manual of the PD4-C, 60C2h:02)."""
    if entry.subindex == 2 and entry.value != _MILLISECONDS:
        raise SdoAbortedError(INVALID_VALUE)


DEVICE_TYPE: Final = 0x0002_0192
"""Value of 1000h: a servo drive of CiA profile 402."""

NO_MODE: Final = 0
HOMING: Final = 6
INTERPOLATED_POSITION: Final = 7
CYCLIC_SYNCHRONOUS_POSITION: Final = 8
_MODES: Final = (HOMING, INTERPOLATED_POSITION, CYCLIC_SYNCHRONOUS_POSITION)
"""Modes that 6060h accepts if 6502h lists them."""
_INTERPOLATE: Final = 1 << 4
"""Bit 4 of the controlword in mode 7, which enables interpolation."""

_STOP_AND_DISABLE, _STOP_AND_STAY = 2, 6
"""Values of 605Ah: after the quick-stop ramp, the drive enters SWITCH ON DISABLED, or stays in QUICK STOP ACTIVE."""
_STAY_OPTIONS: Final = (5, 6, 7, 8)
"""Values of 605Ah with which the drive stays in QUICK STOP ACTIVE."""

_COAST, _RAMP = 0, 2
"""Values of 605Eh: no ramp, and the quick-stop ramp. The simulated drive has no other ramp."""

_WINDOW_OFF: Final = 0xFFFFFFFF


class Profile:
    """CiA 402 objects of a drive.

    Missing objects have defaults: 6007h is 0, 605Ah and 605Eh are 2, 6065h is off, 60B0h and 60B1h are 0.
    """

    def __init__(self, objects: Dictionary, mechanics: Mechanics, mode_changed: Callable[[], None]) -> None:
        self._mode_changed = mode_changed
        o = objects
        o.internal(0x1000, 0, DEVICE_TYPE)
        self.units = FactorGroup(o, mechanics)
        self._makers = MakersRules(o)
        self._enabled = False
        self.abort_option = o.internal(0x6007, 0)
        self.error_code = o.internal(0x603F, 0)
        self.controlword = o.internal(0x6040, 0)
        self.statusword = o.internal(0x6041, 0)
        self.mode = o.internal(0x6060, 0)
        self._quick_stop_option = o.internal(0x605A, 0, _STOP_AND_DISABLE)
        self._fault_reaction_option = o.internal(0x605E, 0, _RAMP)
        self._mode_display = o.internal(0x6061, 0)
        self._position = o.internal(0x6064, 0)
        self._window = o.internal(0x6065, 0, _WINDOW_OFF)
        self._window_time = o.internal(0x6066, 0)
        self._velocity = o.internal(0x606C, 0)
        self._target = o.internal(0x607A, 0)
        self._quick_stop_deceleration = o.internal(0x6085, 0)
        self._homing_method = o.internal(0x6098, 0)
        self._homing_speeds = o.internal(0x6099, 1), o.internal(0x6099, 2)
        self._homing_acceleration = o.internal(0x609A, 0)
        self._home_offset = o.internal(0x607C, 0)
        self._position_offset = o.internal(0x60B0, 0)
        self._velocity_offset = o.internal(0x60B1, 0)
        self._data_record = o.internal(0x60C1, 1)
        self._period, self._exponent = o.internal(0x60C2, 1), o.internal(0x60C2, 2, -3)
        self._following_error = o.internal(0x60F4, 0)
        interpolates = (0x60C1, 1) in o
        supported = sum(1 << mode - 1 for mode in _MODES if mode != INTERPOLATED_POSITION or interpolates)
        self._supported = o.internal(0x6502, 0, supported)
        o.on_write(0x605A, self._quick_stop_option_written)
        o.on_write(0x6060, self._mode_written)
        o.on_write(0x6098, self._method_written)

    def restarted(self) -> None:
        """Update units and mode display after the objects have received their power-on values."""
        self.units.refresh()
        if not self._makers.shows_mode_with_power_alone:
            self._mode_display.value = self.mode.value

    def change(self, *, enabled: bool) -> None:
        """Record whether the drive is in OPERATION ENABLED, and show the mode if it is."""
        self._enabled = enabled
        if enabled:
            self._mode_display.value = self.mode.value

    @property
    def follows_setpoints(self) -> bool:
        """Whether the mode and the controlword let the drive follow setpoints.

        In mode 7, bit 4 of the controlword must be set for this (CiA 402-2).
        """
        if self.mode.value == INTERPOLATED_POSITION:
            return bool(self.controlword.value & _INTERPOLATE) and self._makers.interpolates_linearly
        return self.mode.value == CYCLIC_SYNCHRONOUS_POSITION

    @property
    def setpoint(self) -> float:
        """Position setpoint [counts]: 607Ah, plus 60B0h in mode 8, or 60C1h in mode 7."""
        if self.mode.value == INTERPOLATED_POSITION:
            return self._data_record.value * self.units.position
        offset = self._position_offset.value if self.mode.value == CYCLIC_SYNCHRONOUS_POSITION else 0
        return (self._target.value + offset) * self.units.position

    def hold(self) -> None:
        """Set the setpoint to the actual position."""
        self._target.value = self._data_record.value = self._position.value

    @property
    def feed_forward(self) -> float:
        """Velocity offset of mode 8 [counts/s]; 0 in other modes."""
        cyclic = self.mode.value == CYCLIC_SYNCHRONOUS_POSITION
        return self._velocity_offset.value * self.units.velocity if cyclic else 0.0

    @property
    def interpolation_period(self) -> float:
        """Interpolation period, 60C2h [s]; 0 if not set."""
        return self._period.value * math.pow(10.0, self._exponent.value)

    @property
    def quick_stop_deceleration(self) -> float:
        """Quick-stop deceleration, 6085h [counts/s²]; 0 if not set."""
        return self._quick_stop_deceleration.value * self.units.acceleration

    @property
    def stays_stopped(self) -> bool:
        """Whether the drive stays in QUICK STOP ACTIVE (605Ah)."""
        return self._quick_stop_option.value in _STAY_OPTIONS

    @property
    def coasts_in_fault(self) -> bool:
        """Whether a fault removes the power without a ramp (605Eh)."""
        return self._fault_reaction_option.value == _COAST

    @property
    def window(self) -> tuple[float, float]:
        """Limit of the following error [counts], and the time for which it may be exceeded [s] (6065h, 6066h)."""
        window = math.inf if self._window.value == _WINDOW_OFF else self._window.value * self.units.position
        return window, self._window_time.value * 1e-3

    @property
    def homing(self) -> tuple[int, float, float, float, int]:
        """Homing method, speed towards the switch, speed towards zero, acceleration and home position, in counts."""
        fast, slow = (speed.value * self.units.velocity for speed in self._homing_speeds)
        acceleration = self._homing_acceleration.value * self.units.acceleration
        return self._homing_method.value, fast, slow, acceleration, round(self._home_offset.value * self.units.position)

    def update_actual(self, servo: Servo) -> None:
        """Update the actual position, velocity and following error."""
        units = self.units
        self._position.store(servo.position / units.position)
        self._velocity.store(servo.velocity / units.velocity)
        self._following_error.store(servo.following_error / units.position)

    def _mode_written(self, entry: ObjectEntry, old: int) -> None:
        mode = entry.value
        if mode != NO_MODE and not (mode in _MODES and self._supported.value >> (mode - 1) & 1):
            raise SdoAbortedError(INVALID_VALUE)
        if self._enabled or not self._makers.shows_mode_with_power_alone:
            self._mode_display.value = mode
        if mode != old:
            self._mode_changed()

    def _quick_stop_option_written(self, entry: ObjectEntry, _old: int) -> None:
        if entry.value not in (_STOP_AND_DISABLE, _STOP_AND_STAY):
            raise SdoAbortedError(INVALID_VALUE)

    def _method_written(self, entry: ObjectEntry, _old: int) -> None:
        if entry.value not in (NO_MODE, *EDGES, *STANDING):
            raise SdoAbortedError(INVALID_VALUE)
