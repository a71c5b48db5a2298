"""State of one ODrive, as shown by its messages: position, axis state, errors and faults."""

from __future__ import annotations

import math
from typing import Any

from trirail_drivers.bus.wire import Handler
from trirail_drivers.config import Drives
from trirail_drivers.driver.axis import Axis
from trirail_drivers.driver.cyclic import expected_row
from trirail_drivers.driver.duplicate_node import AnswersPerSync, warning
from trirail_drivers.driver.row_updates import accept_turns
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.interface import DriveFault, PowerState
from trirail_drivers.odrive import cansimple
from trirail_drivers.odrive.cansimple import AxisState, Error, ProcedureResult
from trirail_drivers.odrive.codes import describe_errors

RESET_REQUESTS = 3 * 3
"""Number of error requests after Clear_Errors during which errors do not yet count as a fault: three to each drive."""
STALE_HEARTBEATS = 1
"""Number of heartbeats after a request for a new axis state that may still show the previous state."""
ENABLE_ATTEMPTS = 2
"""Number of requests for closed-loop control after which the procedure result shows whether the drive refuses. After
one request, which may be lost, it may be the result of an earlier procedure.
"""


class OdriveAxis(Axis):
    """Newest feedback of one drive. Each `on_` method handles the data of one message, and may raise struct.error."""

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
        """Axis state in the newest heartbeat."""
        self.errors = 0
        """Active errors and disarm reason, as bits."""
        self.reported = False
        """Whether the drive has answered a Get_Error request."""
        self.requested: AxisState | None = None
        """Axis state requested last; None makes the driver request the target state again."""
        self.modes_sent = 0
        """Number of controller modes sent since the drive was enabled."""
        self.attempts = 0
        """Number of requests for closed-loop control since the drive was enabled."""
        self.reset_until = -math.inf
        """Time until which cleared errors may persist [s]."""
        self._beats = 0
        """Number of heartbeats since the last request."""
        self._started = False
        """Whether the drive is known to have finished booting."""
        self._sends_again = False
        """Whether the drive has sent a message since it fell silent."""
        self._result: int = ProcedureResult.SUCCESS
        """Procedure result in the newest heartbeat."""
        self._answers_per_request = AnswersPerSync(self)

    def is_steady(self, wanted: AxisState | None) -> bool:
        """Whether the drive needs no command and no decision as long as its frames do not change."""
        in_state = wanted is not None and self.requested is wanted and self.state == wanted and self.state_is_current
        well = self.reported and not self.errors and self.event is None and self.reset_until == -math.inf
        follows = self.powered_up or wanted is AxisState.IDLE
        answers = self.configured and self.missed < self.missed_limit and math.isfinite(self.position)
        return in_state and well and follows and answers and self._answers_per_request.is_clear

    @property
    def heartbeat_state(self) -> tuple[int, int]:
        """Axis state and procedure result in the newest heartbeat. Only these two fields affect decisions."""
        return self.state, self._result

    def expected_rows(self, number: int) -> list[tuple[Any, ...]]:
        """Return the rows of driver.cyclic.EXPECTED that describe the frames of drive `number` if nothing changes."""

        def identifier(command: int) -> int:
            return cansimple.identifier(self.node, command)

        beat, decides = cansimple.BEAT.pack(0, *self.heartbeat_state, 0), cansimple.BEAT.pack(0xFFFFFFFF, 0xFF, 0xFF, 0)
        nothing, any_of_it = bytes(cansimple.ESTIMATES.size), b"\xff" * cansimple.ERRORS.size
        return [
            expected_row(identifier(cansimple.GET_ENCODER_ESTIMATES), number, nothing, nothing, position_at=0),
            expected_row(identifier(cansimple.HEARTBEAT), number, beat, decides, lives=True),
            expected_row(identifier(cansimple.GET_ERROR), number, bytes(cansimple.ERRORS.size), any_of_it),
        ]

    def with_setup_listener(self, number: int, handler: Handler) -> Handler:
        """Return a handler that also passes messages with this command number to a set-up that is in progress."""
        identifier = cansimple.identifier(self.node, number)

        def handle(data: bytearray, now: float) -> None:
            if self.setup_listener is not None:
                self.setup_listener(identifier, data)
            handler(data, now)

        return handle

    def ignore_answer(self, data: bytes | bytearray, now: float) -> None:
        """Ignore the message: only a set-up needs it, and receives it through `with_setup_listener`."""

    def set_up(self, turns: float, errors: int, state: int) -> None:
        """Store the state that the drive had at the end of its set-up."""
        self.position = self.scale.metres(turns)
        self.state, self.reported, self._started = state, True, True
        self.note_request(AxisState.IDLE)
        self._update_errors(errors)

    def rejoin(self, now: float) -> None:
        """Let the drive take part in the cycle again after a set-up in the background."""
        self.restarted = self.silent = self.powered_up = self._sends_again = False
        self.heard = now
        self.clear_missed()

    def forget_power_state(self) -> None:
        """Forget the power state reported last; the set-up requests it again."""
        self.state, self.requested = AxisState.UNDEFINED, None

    def on_estimates(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002
        """Handle Get_Encoder_Estimates, which contains the position at the time when the drive received the request."""
        turns, _ = cansimple.ESTIMATES.unpack(data)
        if not self.configured:  # a drive that is booting does not know its position yet
            self._sends_again = True
            return
        if math.isfinite(turns):
            self._answers_per_request.add_position(turns)
            accept_turns(self, turns)
        else:
            self.note_fault("frame", 0, f"position estimate is {turns}; check that its encoder has been calibrated")
        self.answer()

    def end_cycle(self) -> None:
        """Check whether this cycle's positions came from two nodes with the same id."""
        if self._answers_per_request.from_two_nodes():
            self.note_fault("frame", 0, warning(self.node, "each request has two positions"))

    def on_errors(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002
        """Handle Get_Error: active errors and disarm reason."""
        active, reason = cansimple.ERRORS.unpack(data)
        self.reported = True
        self._update_errors(active | reason)
        if active & Error.INITIALIZING:
            self._note_boot()
        elif self.state != AxisState.UNDEFINED:
            self._started = True

    def on_heartbeat(self, data: bytes | bytearray, now: float) -> None:
        """Handle a heartbeat: axis state, errors and procedure result."""
        errors, self.state, self._result, _ = cansimple.BEAT.unpack(data)
        self.heard, self._sends_again = now, self.silent
        self._beats += 1
        self._update_errors(errors)
        if self.state == AxisState.UNDEFINED:  # INITIALIZING may be a disarm reason here, which outlasts the boot
            self._note_boot()
        if self.requested is not AxisState.CLOSED_LOOP_CONTROL:
            # Request idle again if the drive has power that the service does not want. A drive that has restarted may
            # finish the procedures of its own start first, such as an index search, without which it has no position.
            unwanted = self.state == AxisState.CLOSED_LOOP_CONTROL or (self.powered and not self.restarted)
            if unwanted and self.state_is_current:
                self.requested = None
        elif self.state == AxisState.CLOSED_LOOP_CONTROL:
            self.powered_up = True
        elif self.state_is_current and not self.powered_up:
            self._watch_refusal()

    def note_request(self, state: AxisState) -> None:
        """Record that a state was requested from the drive."""
        self.requested = state
        self.attempts += state is AxisState.CLOSED_LOOP_CONTROL
        self._beats = 0

    def power(self, follows: bool) -> PowerState:
        """Return the state of CiA 402 that corresponds to the axis state and the errors.

        `follows` is True if the drive should follow setpoints and is not stopping.
        """
        match self.state:
            case AxisState.UNDEFINED:
                return PowerState.NOT_READY_TO_SWITCH_ON
            case AxisState.IDLE:
                return PowerState.FAULT if self.errors else PowerState.SWITCH_ON_DISABLED
            case _ if self.errors:
                return PowerState.FAULT_REACTION_ACTIVE
            case AxisState.CLOSED_LOOP_CONTROL if follows:
                return PowerState.OPERATION_ENABLED
            case _:  # in a procedure, too, the drive moves its motor without setpoints
                return PowerState.QUICK_STOP_ACTIVE

    @property
    def has_returned(self) -> bool:
        """Whether the drive has restarted, or sends messages again after a silence.

        Its positions may then count from another place.
        """
        return self.restarted or (self.silent and self._sends_again)

    @property
    def powered(self) -> bool:
        """Whether current may flow in the drive's motor."""
        return self.state not in (AxisState.UNDEFINED, AxisState.IDLE)

    def find_fault(self, now: float, follows: bool) -> DriveFault | None:
        """Return the drive's fault at time `now` [s], or None. `follows`: the drive should follow setpoints."""
        if self.event is not None:
            return self.event
        if self.errors and now >= self.reset_until:
            return self.make_fault("fault", self.errors, f"error {describe_errors(self.errors)}")
        if silent := self.silence_fault(now):
            return silent
        if self.powered and self.state != AxisState.CLOSED_LOOP_CONTROL:
            text = f"runs {cansimple.state_name(self.state)}, which the service did not request"
            return self.make_fault("state", 0, text)
        if follows and self.powered_up and self.state != AxisState.CLOSED_LOOP_CONTROL:
            text = f"has left closed loop control by itself and is in {cansimple.state_name(self.state)}"
            return self.make_fault("state", 0, text)
        return None

    def stop_overdue_fault(self, wanted: str, seconds: float) -> DriveFault | None:
        """Return a fault if the drive still has power some time after a command such as "disable".

        `seconds` is the time since the command [s], and `wanted` is the name of the command.
        """
        if not self.powered:
            return None
        text = self.describe_overdue_stop(f"in {cansimple.state_name(self.state)}", "idle", wanted, seconds)
        return self.make_fault("timeout", 0, text)

    @property
    def state_is_current(self) -> bool:
        """Whether the newest heartbeat was sent after the drive received the last request."""
        return self._beats > STALE_HEARTBEATS

    def _update_errors(self, errors: int) -> None:
        """Store the errors of a message."""
        self.errors = errors
        if not errors:
            self.reset_until = -math.inf

    def _note_boot(self) -> None:
        """Record that the drive is booting, if it had finished booting before. It may be a different drive, or may have
        lost its settings or position.
        """
        if not self._started:
            return
        self._started, self.state = False, AxisState.UNDEFINED
        self.restarted, self.boots = True, self.boots + 1
        # This replaces an earlier event, which the restart explains.
        self.event = self.make_fault(
            "state", 0, "has restarted: wait until its settings have been checked, then send reset"
        )

    def _watch_refusal(self) -> None:
        """Latch a fault if the drive refuses closed-loop control; request it again if the request may be lost."""
        if self._result == ProcedureResult.BUSY:
            return
        if self._result == ProcedureResult.SUCCESS or self.attempts < ENABLE_ATTEMPTS:
            if self.state == AxisState.IDLE and not self.errors:
                self.requested = None
            return
        try:
            result = ProcedureResult(self._result).name.lower().replace("_", " ")
        except ValueError:
            result = f"procedure result {self._result}"
        self.note_fault("state", 0, f"refuses closed loop control: {result}")
