"""CiA 402 servo drive with a simulated axis: cyclic synchronous position, interpolated position and homing modes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

from trirail_drivers.interface import PowerState
from trirail_drivers.simulated.device import Device, Nmt
from trirail_drivers.simulated.dictionary import ObjectEntry
from trirail_drivers.simulated.digital import AxisSample, DigitalPins
from trirail_drivers.simulated.factor_group import Mechanics
from trirail_drivers.simulated.homing import HomingMode
from trirail_drivers.simulated.power import FAULT_RESET, STATUS, commanded
from trirail_drivers.simulated.profile import HOMING, Profile
from trirail_drivers.simulated.servo import Servo

MECHANICS: Final = Mechanics()
EDS: Final = Path(__file__).parents[1] / "cia402" / "servo.eds"

FOLLOWING_ERROR = 0x8611
SYNC_LOST = 0x8700

# Controlword bits other than those of the command (CiA 402-2, 6040h; bit 4 as mode 6 defines it).
_HOMING_START = 1 << 4
_HALT = 1 << 8

# Statusword bits other than those of the state (CiA 402-2, 6041h; bits 12 and 13 as modes 6 to 8 define them).
_VOLTAGE_ENABLED = 1 << 4
_REMOTE = 1 << 9
_INTERNAL_LIMIT = 1 << 11
_FOLLOWS_COMMAND = 1 << 12
_FOLLOWING_ERROR_BIT = 1 << 13
_TARGET_REACHED = 1 << 10
_HOMING_ATTAINED = 1 << 12
_HOMING_ERROR = 1 << 13

_STOPPING = (PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE)
_POWERED = (PowerState.OPERATION_ENABLED, *_STOPPING)
_FAULTY = (PowerState.FAULT_REACTION_ACTIVE, PowerState.FAULT)


class SimulatedDrive(Device):
    """Simulated CANopen servo drive with its axis.

    With each SYNC, the axis moves by one interpolation period (60C2h). The SYNC first completes the motion since the
    previous SYNC, then the TPDOs sample the position, and then the latched setpoints are applied. Without SYNC, the
    axis moves with time. Until the loss of SYNC is detected, the axis keeps its velocity. Without power, friction and
    the brake stop the axis and hold it, but a push by hand still moves it.
    """

    def __init__(
        self,
        node: int,
        servo: Servo,
        missed_syncs: int = 3,
        home_switch: float | None = None,
        eds: Path = EDS,
        mechanics: Mechanics = MECHANICS,
        friction: float | None = None,
    ) -> None:
        """`eds` defines the objects and their units; the drive also works if objects are missing. `friction` is the
        deceleration without power [counts/s²], by default the largest one of the motor.
        """
        super().__init__(node, eds)
        self._missed_syncs = missed_syncs
        self.servo = servo
        self._friction = servo.max_acceleration if friction is None else friction
        self.homing = HomingMode(servo, home_switch)
        self.state = PowerState.NOT_READY_TO_SWITCH_ON
        self.power_up_time = 0.0
        """Time from the command "enable operation" until the drive controls its motor [s], in which a brake opens."""
        self._powered_at = math.inf
        self._synchronised = False
        self._moved_at = 0.0
        self._heard_period = 0.0
        """Measured time between the last two SYNCs [s]."""
        self._setpoint_given = False
        self._beyond_window: float | None = None
        self._profile = Profile(self.objects, mechanics, self._mode_changed)
        self.syncs = 0
        """Number of SYNCs received since power-on."""
        self.pins = DigitalPins(self.objects, lambda: AxisSample(self._now, self.syncs, self.servo.position))
        self.objects.on_write(0x6040, self._control)
        self.objects.on_write(0x607A, self._setpoint_written)
        self.objects.on_write(0x60C1, self._setpoint_written)

    @property
    def power(self) -> PowerState:
        """State of the power state machine."""
        return self.state

    def press(self, switches: int) -> None:
        """Press the given switches of the slider, bits of the digital inputs 60FDh, and release the others."""
        self.pins.press(switches, self._now)
        self._up_to_date = False

    def fail(self, code: int) -> None:
        """Enter the fault state (transition 13 and, at standstill, 14), and report `code` in EMCY and 603Fh."""
        if self.state in _FAULTY:
            return
        self._up_to_date = False
        self.fault = self._profile.error_code.value = code
        self.errors.report(code)
        coasts = self._profile.coasts_in_fault
        self._change(PowerState.FAULT if coasts else PowerState.FAULT_REACTION_ACTIVE)

    # Methods of Device that CiA 402 extends.

    def restarted(self) -> None:
        """Restart the drive profile: perform transitions 0 and 1."""
        self.fault = 0
        self._synchronised = self._setpoint_given = False
        self._moved_at = self._now
        self._heard_period = 0.0
        self.syncs = 0
        self.homing.forget()
        self._profile.restarted()
        self.pins.restarted()
        self._change(PowerState.SWITCH_ON_DISABLED)

    def before_sync(self) -> None:
        """Move the axis from one setpoint to the next, except at the first SYNC, before which it moved with time."""
        self.syncs += 1
        if self._synchronised:
            self._heard_period = self._now - self._moved_at
            self._move(self._step, self._profile.feed_forward)
        self._synchronised = True
        self._moved_at = self._now

    def time_passed(self, now: float) -> None:
        """Move the axis with time, without velocity offset, unless SYNCs determine the motion; let inputs bounce."""
        self.pins.poll(now)
        if now >= self._powered_at:
            self._change(PowerState.OPERATION_ENABLED)
        if not self._synchronised and now > self._moved_at:
            self._move(now - self._moved_at, 0.0)
            self._moved_at = now

    def sync_timeout(self) -> float:
        """Return the time without SYNC after which SYNC counts as lost [s].

        This is `missed_syncs` SYNC periods (1006h) or, if 1006h is not set, interpolation periods. If neither period is
        known, as before the second SYNC, the time is infinite.
        """
        return self._missed_syncs * (self._sync_period.value * 1e-6 or self._step) or math.inf

    @property
    def _step(self) -> float:
        """Time from one setpoint to the next [s]: 60C2h or 1006h if set, otherwise the measured SYNC period."""
        return self._profile.interpolation_period or self._sync_period.value * 1e-6 or self._heard_period

    def sync_lost(self, at: float) -> None:
        """Let the axis move with time; enter the fault state if the drive is enabled and expects SYNC (1006h)."""
        self._synchronised = False
        self.servo.coast(at - self._moved_at)
        self._moved_at = at
        expected = self._sync_period.value and self.nmt is Nmt.OPERATIONAL
        if expected and self.state is PowerState.OPERATION_ENABLED:
            self.fail(SYNC_LOST)

    def connection_lost(self, code: int) -> None:
        """React to the loss of the master as the abort connection option code specifies (CiA 402-2, 6007h)."""
        if self.state is not PowerState.OPERATION_ENABLED:
            return
        match self._profile.abort_option.value:
            case 1:
                self.fail(code)
            case 2:
                self._change(PowerState.SWITCH_ON_DISABLED)
            case 3:
                self._change(PowerState.QUICK_STOP_ACTIVE)

    # The power state machine.

    def _control(self, entry: ObjectEntry, old: int) -> None:
        if self.state is PowerState.FAULT:
            if entry.value & ~old & FAULT_RESET:  # transition 15
                fault, self.fault = self.fault, 0
                self._change(PowerState.SWITCH_ON_DISABLED)
                self.errors.clear(fault)
            return
        state = commanded(self.state, entry.value, self._profile.stays_stopped)
        if state is not PowerState.OPERATION_ENABLED:
            self._powered_at = math.inf
        if state is not self.state:
            if self.power_up_time and state is PowerState.OPERATION_ENABLED and self.state not in _POWERED:
                self._powered_at = min(self._powered_at, self._now + self.power_up_time)
            else:
                self._change(state)
        elif self._homes:
            self._home(entry.value, old)

    def _change(self, state: PowerState) -> None:
        if self.state is PowerState.OPERATION_ENABLED:
            self._setpoint_given = False
            self.homing.interrupt()
        self.state, self._powered_at = state, math.inf
        self._profile.change(enabled=state is PowerState.OPERATION_ENABLED)
        if state is PowerState.OPERATION_ENABLED:
            self._beyond_window = None
            if not self._setpoint_given:
                self._profile.hold()
        self._publish()

    # Motion.

    def _move(self, step: float, feed_forward: float) -> None:
        if self.state not in _POWERED:
            self.servo.roll(self._friction, step)
        elif self._follows_command:
            self.servo.follow(self._profile.setpoint, feed_forward, step)
            self._watch_following_error(step)
        elif self._homes and self.homing.under_way:
            self.homing.move(step, bool(self._profile.controlword.value & _HALT))
        else:
            self.servo.brake(self._profile.quick_stop_deceleration or self.servo.max_acceleration, step)
            if self.servo.velocity == 0.0:
                self._standstill()
        self._publish()

    @property
    def _follows_command(self) -> bool:
        return self.state is PowerState.OPERATION_ENABLED and self._profile.follows_setpoints

    @property
    def _homes(self) -> bool:
        return self.state is PowerState.OPERATION_ENABLED and self._profile.mode.value == HOMING

    def _home(self, word: int, old: int) -> None:
        """Start homing when controlword bit 4 becomes 1, and interrupt it when the bit becomes 0 (CiA 402-2)."""
        if word & ~old & _HOMING_START:
            self.homing.start(*self._profile.homing)
        elif old & ~word & _HOMING_START:
            self.homing.interrupt()
        self._publish()

    def _standstill(self) -> None:
        """Perform transition 14, or transition 12 if the drive does not stay in QUICK STOP ACTIVE."""
        if self.state is PowerState.FAULT_REACTION_ACTIVE:
            self._change(PowerState.FAULT)
        elif self.state is PowerState.QUICK_STOP_ACTIVE and not self._profile.stays_stopped:
            self._change(PowerState.SWITCH_ON_DISABLED)

    def _watch_following_error(self, step: float) -> None:
        """Enter the fault state if the following error exceeds its window for too long (CiA 402-2, 6065h, 6066h)."""
        window, time = self._profile.window
        if abs(self.servo.following_error) <= window:
            self._beyond_window = None
            return
        self._beyond_window = 0.0 if self._beyond_window is None else self._beyond_window + step
        if self._beyond_window >= time:
            self.fail(FOLLOWING_ERROR)

    def _publish(self) -> None:
        """Update the actual values and the statusword."""
        self._profile.update_actual(self.servo)
        status = STATUS[self.state] | _VOLTAGE_ENABLED | _REMOTE
        if self._follows_command:
            status |= _FOLLOWS_COMMAND
            if self.servo.limited:
                status |= _INTERNAL_LIMIT
        if self._profile.mode.value == HOMING:
            status |= self._homing_bits()
        if self.fault == FOLLOWING_ERROR:
            status |= _FOLLOWING_ERROR_BIT
        self._profile.statusword.value = status

    def _homing_bits(self) -> int:
        """Return the bits "error", "attained" and "target reached" (axis at rest) (CiA 402-2, homing mode)."""
        homing = self.homing
        meant_to_stand = not homing.under_way or bool(self._profile.controlword.value & _HALT)
        return (
            _TARGET_REACHED * (meant_to_stand and self.servo.velocity == 0.0)
            | _HOMING_ATTAINED * homing.attained
            | _HOMING_ERROR * homing.failed
        )

    # Writes.

    def _mode_changed(self) -> None:
        """Reset homing. Some drives take the level of controlword bit 4, and start homing with the change of mode."""
        self.homing.forget()
        if self._homes and self._profile.controlword.value & _HOMING_START:
            self.homing.start(*self._profile.homing)
        self._publish()

    def _setpoint_written(self, _entry: ObjectEntry, _old: int) -> None:
        self._setpoint_given = True
