"""The objects of CiA 402 that a simulated drive goes by, in counts and seconds, whatever units they are in."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from trirail_drivers.simulated.dictionary import INVALID_VALUE, Dictionary, ObjectEntry, SdoAbort
from trirail_drivers.simulated.factor_group import FactorGroup, Mechanics
from trirail_drivers.simulated.homing import EDGES, STANDING
from trirail_drivers.simulated.makes import MakersRules
from trirail_drivers.simulated.servo import Servo

DEVICE_TYPE: Final = 0x0002_0192
"""1000h: a servo drive of CiA profile 402."""

NO_MODE: Final = 0
HOMING: Final = 6
INTERPOLATED_POSITION: Final = 7
CYCLIC_SYNCHRONOUS_POSITION: Final = 8
_MODES: Final = (HOMING, INTERPOLATED_POSITION, CYCLIC_SYNCHRONOUS_POSITION)
"""What 6060h takes, of those in 6502h."""
_INTERPOLATE: Final = 1 << 4
"""The controlword's bit 4, as mode 7 defines it."""

_STOP_AND_DISABLE, _STOP_AND_STAY = 2, 6
"""605Ah: by the quick-stop ramp into SWITCH ON DISABLED, or staying in QUICK STOP ACTIVE."""
_STAYS: Final = (5, 6, 7, 8)
"""Values of 605Ah after which it stays there."""

_WINDOW_OFF: Final = 0xFFFFFFFF


class Profile:
    """What its dictionary lacks, the drive does without: 6007h as 0, 605Ah as 2, 6065h as no window, 60B1h as none."""

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
        self._velocity_offset = o.internal(0x60B1, 0)
        self._data_record = o.internal(0x60C1, 1)
        self._period, self._exponent = o.internal(0x60C2, 1), o.internal(0x60C2, 2, -3)
        self.inputs = o.internal(0x60FD, 0)
        self._following_error = o.internal(0x60F4, 0)
        interpolates = (0x60C1, 1) in o
        supported = sum(1 << mode - 1 for mode in _MODES if mode != INTERPOLATED_POSITION or interpolates)
        self._supported = o.internal(0x6502, 0, supported)
        o.on_write(0x605A, self._quick_stop_option_written)
        o.on_write(0x6060, self._mode_written)
        o.on_write(0x6098, self._method_written)

    def restarted(self) -> None:
        """The objects have their power-on values."""
        self.units.refresh()
        if not self._makers.shows_mode_with_power_alone:
            self._mode_display.value = self.mode.value

    def change(self, *, enabled: bool) -> None:
        """Have power, in operation enabled, or none."""
        self._enabled = enabled
        if enabled:
            self._mode_display.value = self.mode.value

    @property
    def follows_setpoints(self) -> bool:
        """Whether mode and controlword have it follow setpoints; mode 7 does while bit 4 is set (CiA 402-2)."""
        if self.mode.value == INTERPOLATED_POSITION:
            return bool(self.controlword.value & _INTERPOLATE) and self._makers.interpolates_linearly
        return self.mode.value == CYCLIC_SYNCHRONOUS_POSITION

    @property
    def setpoint(self) -> float:
        """Where it is to be [counts]: 607Ah, in mode 7 60C1h."""
        entry = self._data_record if self.mode.value == INTERPOLATED_POSITION else self._target
        return entry.value * self.units.position

    def hold(self) -> None:
        """Make where it is the setpoint."""
        self._target.value = self._data_record.value = self._position.value

    @property
    def feed_forward(self) -> float:
        """The velocity offset of mode 8 [counts/s]."""
        cyclic = self.mode.value == CYCLIC_SYNCHRONOUS_POSITION
        return self._velocity_offset.value * self.units.velocity if cyclic else 0.0

    @property
    def interpolation_period(self) -> float:
        """60C2h [s]; 0 where it is not set."""
        return self._period.value * math.pow(10.0, self._exponent.value)

    @property
    def quick_stop_deceleration(self) -> float:
        """6085h [counts/s²]; 0 where it is not set."""
        return self._quick_stop_deceleration.value * self.units.acceleration

    @property
    def stays_stopped(self) -> bool:
        """Whether it stays in QUICK STOP ACTIVE (605Ah)."""
        return self._quick_stop_option.value in _STAYS

    @property
    def window(self) -> tuple[float, float]:
        """How far it may be from its setpoint [counts], and beyond that how long [s] (6065h, 6066h)."""
        window = math.inf if self._window.value == _WINDOW_OFF else self._window.value * self.units.position
        return window, self._window_time.value * 1e-3

    @property
    def homing(self) -> tuple[int, float, float, float, int]:
        """Method, speeds towards switch and zero, acceleration, and the position at home, in counts."""
        fast, slow = (speed.value * self.units.velocity for speed in self._homing_speeds)
        acceleration = self._homing_acceleration.value * self.units.acceleration
        return self._homing_method.value, fast, slow, acceleration, round(self._home_offset.value * self.units.position)

    def update_actual(self, servo: Servo) -> None:
        """Bring the actual values up to date."""
        units = self.units
        self._position.store(servo.position / units.position)
        self._velocity.store(servo.velocity / units.velocity)
        self._following_error.store(servo.following_error / units.position)

    def _mode_written(self, entry: ObjectEntry, old: int) -> None:
        mode = entry.value
        if mode != NO_MODE and not (mode in _MODES and self._supported.value >> (mode - 1) & 1):
            raise SdoAbort(INVALID_VALUE)
        if self._enabled or not self._makers.shows_mode_with_power_alone:
            self._mode_display.value = mode
        if mode != old:
            self._mode_changed()

    def _quick_stop_option_written(self, entry: ObjectEntry, _old: int) -> None:
        if entry.value not in (_STOP_AND_DISABLE, _STOP_AND_STAY):
            raise SdoAbort(INVALID_VALUE)

    def _method_written(self, entry: ObjectEntry, _old: int) -> None:
        if entry.value not in (NO_MODE, *EDGES, *STANDING):
            raise SdoAbort(INVALID_VALUE)
