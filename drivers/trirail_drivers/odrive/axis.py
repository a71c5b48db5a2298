"""One ODrive as its messages tell of it: position, state, errors, and what is wrong with it."""

from __future__ import annotations

import math
from typing import Any

from trirail_drivers.config import Drives
from trirail_drivers.driver.axis import Axis
from trirail_drivers.driver.cyclic import expected
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.interface import DriveFault, PowerState
from trirail_drivers.odrive import cansimple
from trirail_drivers.odrive.cansimple import AxisState, ProcedureResult
from trirail_drivers.odrive.codes import words
from trirail_drivers.odrive.flat_endpoints import Version

RESET_TIME = 3 * 3 * cansimple.ERROR_PERIOD
"""How long errors may be told of after they were cleared, in which each drive is asked three times [s]."""
STALE_HEARTBEATS = 1
"""So many heartbeats after a request may still be from before it."""


class OdriveAxis(Axis):
    """One drive's newest feedback; the `on_` methods take a message's data or raise struct.error."""

    def __init__(self, name: str, node: int, scale: Scale, drives: Drives) -> None:
        super().__init__(name, node, scale, drives)
        self.wanted = self.sent = self.in_force = math.nan
        self.floats, self.still = True, math.inf
        self.velocity_per_metre, self.velocity_step, self.velocity_bytes = (
            scale.counts_per_metre,
            cansimple.VELOCITY_STEP,
            2,
        )
        self.position_at, self.velocity_at = 0, 4
        self.state: int = AxisState.UNDEFINED
        """Axis state of the newest heartbeat."""
        self.errors = 0
        """Active errors, and why it was disarmed."""
        self.reported = False
        """It has answered what its errors are."""
        self.version: Version | None = None
        """Of its hardware and firmware, once it told."""
        self.sdo: tuple[int, bytes] | None = None
        """Endpoint and value of the newest TxSdo."""
        self.requested: AxisState | None = None
        """The state it was asked for last; None makes the driver ask anew."""
        self.reset_until = -math.inf
        """Until when clearing the errors is under way [s]."""
        self._beats = 0
        self._initialised = False
        self._restarted = False
        self._result: int = ProcedureResult.SUCCESS

    def rests(self, wanted: AxisState | None) -> bool:
        """Whether nothing is to be done for it, nor found out, as long as its frames say nothing new."""
        in_state = wanted is not None and self.requested is wanted and self.state == wanted and self.obeys
        well = self.reported and not self.errors and self.event is None and self.reset_until == -math.inf
        follows = self.powered_up or wanted is AxisState.IDLE
        return in_state and well and follows and self.missed == 0 and math.isfinite(self.position)

    @property
    def said(self) -> tuple[int, int]:
        """What of its newest heartbeat decides something: state, and how the last procedure ended."""
        return self.state, self._result

    def expected(self, number: int) -> list[tuple[Any, ...]]:
        """The frames that say nothing new of it, as rows of trirail_drivers.driver.cyclic.EXPECTED; it has a number."""

        def of(command: int) -> int:
            return cansimple.identifier(self.node, command)

        beat, decides = cansimple.BEAT.pack(0, *self.said, 0), cansimple.BEAT.pack(0xFFFFFFFF, 0xFF, 0xFF, 0)
        nothing, any_of_it = bytes(cansimple.ESTIMATES.size), b"\xff" * cansimple.ERRORS.size
        return [
            expected(of(cansimple.GET_ENCODER_ESTIMATES), number, nothing, nothing, position_at=0),
            expected(of(cansimple.HEARTBEAT), number, beat, decides, lives=True),
            expected(of(cansimple.GET_ERROR), number, bytes(cansimple.ERRORS.size), any_of_it),
        ]

    def input_pos(self, position: float, velocity: float) -> bytes:
        """Set_Input_Pos of a setpoint [m], [m/s]; OverflowError or struct.error where it holds none such."""
        return cansimple.input_pos(self.scale.exact(position), self.scale.counts_per_metre * velocity)

    def on_version(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002  one signature for all
        """Get_Version."""
        _, line, number, variant, major, minor, revision, unreleased = cansimple.VERSION.unpack(data)
        self.version = Version((line, number, variant), (major, minor, revision), bool(unreleased))

    def on_sdo(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002
        """TxSdo: the value of an endpoint that was asked for; its length is the endpoint's."""
        _, endpoint, _ = cansimple.SDO.unpack_from(data)
        self.sdo = endpoint, bytes(data[cansimple.SDO.size :])

    def on_estimates(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002
        """Get_Encoder_Estimates: the position when the request came."""
        turns, _ = cansimple.ESTIMATES.unpack(data)
        self.answer()
        if math.isfinite(turns):
            self.position = self.scale.metres(turns)
        else:
            self.note_fault("frame", 0, f"position estimate is {turns}: has its encoder been calibrated?")

    def on_errors(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002
        """Get_Error: active errors and disarm reason."""
        active, reason = cansimple.ERRORS.unpack(data)
        self.reported = True
        self._take_errors(active | reason)

    def on_heartbeat(self, data: bytes | bytearray, now: float) -> None:
        """Heartbeat: the drive lives; its state, errors and how the last procedure ended."""
        errors, self.state, self._result, _ = cansimple.BEAT.unpack(data)
        self.heard = now
        self._beats += 1
        self._take_errors(errors)
        if self.state == AxisState.CLOSED_LOOP_CONTROL:
            if self.requested is AxisState.CLOSED_LOOP_CONTROL:
                self.powered_up = True
            elif self.obeys:
                self.requested = None  # it still has power: tell it again
        elif self.requested is AxisState.CLOSED_LOOP_CONTROL and self.obeys and not self.powered_up:
            self._watch_refusal()

    def note_request(self, state: AxisState) -> None:
        """Note that the drive was asked for a state."""
        self.requested = state
        self._beats = 0

    def forgive(self, now: float) -> None:
        """Forget what happened, but not what lasts, and allow time for errors to be cleared."""
        if not self._restarted:
            self.event = None
        if self.errors:
            self.reset_until = now + RESET_TIME

    def power(self, follows: bool) -> PowerState:
        """The state as CiA 402 has it; `follows` tells whether it is to follow setpoints, rather than to stop."""
        match self.state:
            case AxisState.UNDEFINED:
                return PowerState.NOT_READY_TO_SWITCH_ON
            case AxisState.IDLE:
                return PowerState.FAULT if self.errors else PowerState.SWITCH_ON_DISABLED
            case AxisState.CLOSED_LOOP_CONTROL if self.errors:
                return PowerState.FAULT_REACTION_ACTIVE
            case AxisState.CLOSED_LOOP_CONTROL:
                return PowerState.OPERATION_ENABLED if follows else PowerState.QUICK_STOP_ACTIVE
            case _:
                return PowerState.SWITCHED_ON

    @property
    def powered(self) -> bool:
        """Whether there may be current in its motor."""
        return self.state not in (AxisState.UNDEFINED, AxisState.IDLE)

    def fault(self, now: float, follows: bool) -> DriveFault | None:
        """What is wrong with the drive at time `now`, given whether it is to follow setpoints."""
        if self.event is not None:
            return self.event
        if self.errors and now >= self.reset_until:
            return self.made("fault", self.errors, f"error {words(self.errors)}")
        if silent := self.silence(now):
            return silent
        if self.state in cansimple.PROCEDURES:
            return self.made("state", 0, f"is in {cansimple.state_name(self.state)}, on whoever's command")
        if follows and self.powered_up and self.state != AxisState.CLOSED_LOOP_CONTROL:
            return self.made("state", 0, f"left closed loop control unasked: {cansimple.state_name(self.state)}")
        return None

    def late_for(self, wanted: str, seconds: float) -> DriveFault | None:
        """What is wrong where `seconds` [s] after it was `wanted` to lose its power the drive has not."""
        if not self.powered:
            return None
        text = f"is in {cansimple.state_name(self.state)} {seconds:g} s after {wanted}; idle was expected"
        return self.made("timeout", 0, text)

    @property
    def obeys(self) -> bool:
        """Enough heartbeats have come since the last request for the newest to be an answer to it."""
        return self._beats > STALE_HEARTBEATS

    def _take_errors(self, errors: int) -> None:
        self.errors = errors
        if not errors:
            self.reset_until = -math.inf
        self._watch_restart()

    def _watch_restart(self) -> None:
        """A drive that begins anew may have lost count of its turns."""
        begins = self.state == AxisState.UNDEFINED or bool(self.errors & cansimple.Error.INITIALIZING)
        if not begins:
            self._initialised = True
        elif self._initialised:
            self._restarted = True
            # Takes the place of an earlier event, for it is the one that a reset cannot help.
            self.event = self.made("state", 0, "has restarted and may have lost its position; restart the service")

    def _watch_refusal(self) -> None:
        if self._result in (ProcedureResult.SUCCESS, ProcedureResult.BUSY):
            return
        try:
            result = ProcedureResult(self._result).name.lower().replace("_", " ")
        except ValueError:
            result = f"procedure result {self._result}"
        self.note_fault("state", 0, f"refuses closed loop control: {result}")
