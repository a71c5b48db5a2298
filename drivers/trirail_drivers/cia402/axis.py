"""State of one CiA 402 drive, as shown by its frames: position, power state and faults."""

from __future__ import annotations

import math
from typing import Any

from trirail_drivers.cia402 import canopen_frames, process_data
from trirail_drivers.cia402.codes import describe_error
from trirail_drivers.cia402.duplicate_node import AnswersAfterStop
from trirail_drivers.cia402.pending_request import PendingRequest
from trirail_drivers.cia402.shown_mode import ShownMode
from trirail_drivers.cia402.units import Units
from trirail_drivers.config import DigitalIo, Drives
from trirail_drivers.driver.axis import SILENT_AFTER, Axis
from trirail_drivers.driver.axis_row import NOTHING_SENT
from trirail_drivers.driver.cyclic import expected_row
from trirail_drivers.driver.duplicate_node import AnswersPerSync, warning
from trirail_drivers.driver.row_updates import accept_counts, accept_statusword
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.interface import DriveFault, PowerState

MISSED_STATUSES = 3
STATUS_WITHIN = MISSED_STATUSES * canopen_frames.STATUS_PERIOD
"""Least time without a statusword after which a drive is lost [s]."""
FOLLOW_TIME = STATUS_WITHIN
"""Longest time until an enabled drive reports that it follows setpoints [s]."""
REGISTER_TIME = 0.5
"""Longest time until a drive reports its error register after a reset [s]."""
SUPERVISED_ANSWER_TIME = canopen_frames.STATUS_PERIOD / 2
"""Like ANSWER_TIME, of a drive whose statusword or inputs are requested by SDO [s]."""
ANSWER_TIME = 0.5
"""Longest time until a drive answers an SDO request from the cycle [s]. A set-up waits this long before it starts."""
STANDSTILL_DISTANCE_M = 2e-5
"""Distance [m] within which a slider must stay for STANDSTILL_TIME_S to count as at rest."""
STANDSTILL_TIME_S = 0.1
WORD_REPEATS = 2
"""Number of times that the start of interpolation is sent again to a drive whose statusword does not show it."""
SENSOR_ERRORS = 0x7300
"""Error codes 73xxh of CiA 402-2, which concern the encoder."""
RESET_TIME = 2 * canopen_frames.STATUS_PERIOD
"""Longest time until a drive leaves the fault state after a fault reset [s]: two periods of its statusword."""

_RESTARTED = "has restarted and lost its set-up: wait until the drive is configured again, then send reset"
_NMT_STATES = {canopen_frames.STOPPED: "stopped", canopen_frames.PRE_OPERATIONAL: "pre-operational"}
_POLLS = (canopen_frames.STATUSWORD_UPLOAD, canopen_frames.MODE_DISPLAY_UPLOAD, canopen_frames.INPUTS_UPLOAD)
_STATE_BITS = 0x6F
"""Bits of a statusword that encode the state."""
_IN_FAULT = (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE)
_WITHOUT_POWER = (PowerState.NOT_READY_TO_SWITCH_ON, PowerState.SWITCH_ON_DISABLED)
_ENABLING_STATES = (PowerState.SWITCH_ON_DISABLED, PowerState.READY_TO_SWITCH_ON, PowerState.SWITCHED_ON)
"""States that a drive passes through before it reaches "operation enabled"."""
_ENABLED_OR_ENABLING = (PowerState.READY_TO_SWITCH_ON, PowerState.SWITCHED_ON, PowerState.OPERATION_ENABLED)
"""States that every drive leaves when it is commanded to stop or to remove power."""


class Cia402Axis(Axis):
    """Newest feedback of one drive. Each `on_` method handles the data of one frame, and may raise struct.error."""

    _received_inputs = 0
    """Newest digital inputs."""
    _changed_inputs = 0
    """Inputs whose change will be in the next feedback; their later changes will be in the feedback after it."""
    _inputs_overtaken = False
    """Whether the inputs have arrived by PDO since they were last requested by SDO, as `_overtaken`."""
    inputs_due = -math.inf
    """Time of the next SDO request for the inputs [s], if they are polled."""

    def __init__(self, name: str, node: int, scale: Scale, drives: Drives) -> None:
        super().__init__(name, node, scale, drives)
        self.set_up(
            process_data.default_exchange(node), Units(scale, scale.counts_per_metre, abs(scale.counts_per_metre))
        )
        self.velocity_step, self.velocity_bytes = 1.0, 4
        self.still = max(1.0, abs(scale.counts_per_metre) * STANDSTILL_DISTANCE_M)
        self.status_heard = self.stands_since = math.inf
        self.status_within = STATUS_WITHIN
        self.homes = False
        """Whether the drive has a homing method, since its encoder is incremental."""
        self.has_setpoint = False
        """Whether the drive has been sent a setpoint."""
        self.state = PowerState.NOT_READY_TO_SWITCH_ON
        self.controlword = canopen_frames.DISABLE_VOLTAGE
        self.word_repeats = 0
        """Number of times that the last controlword has been sent again."""
        self.mode_bits = 0
        """Mode-specific controlword bits, added to "enable operation"."""
        self.held: int | None = None
        """Position [counts] that is sent to the drive instead of setpoints, if any."""
        self.mode = ShownMode(drives.sdo_timeout)
        self.cyclic = True
        """Whether the drive is certain to be in the mode in which it follows setpoints."""
        self.follows = True
        """Whether the drive follows setpoints, or will soon do so; until then, setpoints must equal its position."""
        self.has_followed = False
        """Whether the drive has reported, since it was enabled, that it follows setpoints."""
        self.sdo_answer: bytes | None = None
        """Answer to the SDO request that `sdo_asked` identified; None before the answer."""
        self.error_code = 0
        """Last error code that the drive reported; 0 once it has reported the end of the error."""
        self.reset_until = -math.inf
        """Time until which a fault reset may take effect [s]."""
        self.status_wanted = False
        """Whether the statusword must be requested by SDO: the last heartbeat showed a state without PDOs, or a
        controlword has been sent by SDO.
        """
        self.left_operational, self.left_at = False, 0
        """Whether the drive has left NMT operational, and its set-up has not been checked since then; and the number of
        the SYNC after which it last left without a boot.
        """
        self.sdo_asked: bytes | None = None
        """Index of the object whose SDO answer is pending, little-endian."""
        self._pending = PendingRequest()
        self.word_by_sdo: int | None = None
        """Controlword sent last by SDO; None if the drive may have lost it, or has since been sent another by PDO."""
        self.poll_due = self._register_until = -math.inf
        """Time of the next statusword request, and time until which the error register may arrive [s]."""
        self.register_wanted = False
        """Whether the drive's error register 1001h must be requested."""
        self._statusword_asked = self._overtaken = False
        """Whether the statusword has been requested by SDO, and whether it has arrived by PDO since then.

        The PDO may be newer than the answer, since it has a higher priority on the bus.
        """
        self._operational = self._followed = self.stopped = False
        self._unfollowed_since: float | None = None
        self._answers_per_sync, self._answers_after = AnswersPerSync(self), AnswersAfterStop()

    def assign_io(self, io: DigitalIo) -> None:
        """Set the digital outputs and inputs that the robot uses, and the default exchange that includes them."""
        super().assign_io(io)
        self.set_up(process_data.default_exchange(self.node, io), self.units)

    def set_up(self, exchange: process_data.Exchange, units: Units) -> None:
        """Set the frames and units of the exchange, after the set-up has written the safe values of the outputs."""
        self.exchange, self.units = exchange, units
        self.maps_outputs, self.outputs_kept = exchange.outputs is not None, exchange.outputs_kept
        self.outputs_sent = NOTHING_SENT
        self.velocity_per_metre = units.velocity_per_metre
        self.position_at, self.velocity_at, self.controlword_at = map(exchange.setpoints.offset, range(3))

    @property
    def configured(self) -> bool:
        """Whether the drive's set-up is still valid. It may be lost if the drive has left NMT operational, since the
        drive may have restarted and its boot-up message may have been lost.
        """
        return super().configured and not self.left_operational

    def forget_power_state(self) -> None:
        """Forget the last power state, and stop looking for positions of another node, since a new set-up begins."""
        self.state = PowerState.NOT_READY_TO_SWITCH_ON
        self.forget_requests()
        self._statusword_asked = self._overtaken = False
        self._answers_after.forget()

    def note_request(self, now: float, request: bytes) -> None:
        """Record an SDO request."""
        if request == canopen_frames.STATUSWORD_UPLOAD:
            self._statusword_asked, self._overtaken = True, False
        elif request == canopen_frames.INPUTS_UPLOAD:
            self._inputs_overtaken = False
            self.inputs_due = now + canopen_frames.POLL_PERIOD  # also if the drive refuses the request
        if self.unanswered:  # the drive may lose the earlier request
            self.word_by_sdo, self.outputs_sent = None, NOTHING_SENT
        # Until an answer is counted as lost, no statusword is requested; a few lost answers must not become a fault.
        polled = self.exchange.polled or self.exchange.inputs_polled
        supervises = (request in _POLLS or polled) and not self.left_operational
        self._pending.begin(now, request, SUPERVISED_ANSWER_TIME if supervises else ANSWER_TIME)

    @property
    def unanswered(self) -> bool:
        """Whether the newest SDO request has not been answered yet."""
        return self._pending.unanswered

    def accepts_request(self, now: float) -> bool:
        """Whether an SDO request may be sent at time `now` [s], since a server handles one at a time (CiA 301).

        A request that has been unanswered for too long is lost.
        """
        if self._pending.is_lost(now):
            self.forget_requests()
        return not self.unanswered

    def forget_requests(self) -> None:
        """Await no answer, and send again what the drive may have lost."""
        self._pending.forget()
        self.word_by_sdo, self.outputs_sent = None, NOTHING_SENT

    def rejoin(self, exchange: process_data.Exchange, units: Units, now: float, *, homed: bool) -> None:
        """Let the drive take part in the cycle again after a set-up in the background."""
        self.set_up(exchange, units)
        self.restarted = self.silent = self.left_operational = self.status_wanted = False
        self.stopped = self._operational = False
        self.powered_up = self.has_followed = self._followed = self.has_setpoint = False
        self.mode.shown, self.cyclic, self.follows, self.held, self.mode_bits = exchange.mode_shown, True, True, None, 0
        self.controlword, self.sdo_asked, self.homed = canopen_frames.DISABLE_VOLTAGE, None, homed
        self.status_heard, self.heard = now, now if exchange.heard else math.inf
        self.clear_missed()

    @property
    def last_heard(self) -> float:
        """Time of the last sign of life other than a position [s]."""
        return max(self.status_heard, super().last_heard)

    def lose(self, *, stopping: bool) -> None:
        """Record that the bus is lost, so that the drive's set-up must be checked again.

        If `stopping` is False, the drive is assumed to have no power.
        """
        self.silent = True
        self.forget_requests()
        if not stopping:
            self.forget_power_state()

    @property
    def setpoint(self) -> tuple[int, int]:
        """Setpoint sent last, in drive units; before the first setpoint, the drive's actual position."""
        return (int(self.target), self.offset) if self.has_setpoint else (self.actual, 0)

    def on_position(self, data: bytes | bytearray, now: float) -> None:
        """Handle TPDO2: the position sampled at a SYNC, and the statusword if it is mapped in the same PDO."""
        if not self.configured:  # a drive that started by itself may send anything; this also detects duplicate nodes
            self.came = True
            return
        counts, statusword = self.exchange.feedback.unpack(data)
        self._answers_per_sync.add_position(counts)
        accept_counts(self, counts, now)
        self.answer()
        if statusword is not None:
            self._overtaken = self._statusword_asked
            self.update_status(statusword, now)
        self._operational = True  # CiA 301: PDOs are sent only in NMT operational

    def is_steady(self, wanted: canopen_frames.TargetState) -> bool:
        """Whether the drive needs no command and no decision as long as its frames do not change."""
        settled = self.state is wanted and wanted is not PowerState.QUICK_STOP_ACTIVE
        no_fault = self.event is None and not self.error_code and self.reset_until == -math.inf
        lives = self._operational and not (
            self.stopped or self.left_operational or self.status_wanted or self.register_wanted
        )
        polled = self.exchange.polled or self.exchange.inputs_polled
        asked = self.sdo_asked is not None or polled or self.awaits_mode
        follows = wanted is PowerState.OPERATION_ENABLED and self.exchange.tells_following
        quiet = self._answers_after.idle and self._answers_per_sync.is_clear and self._unfollowed_since is None
        return (
            (settled and no_fault and lives and quiet and not asked)
            and (self.cyclic and self.follows and self.holds is None and self.has_setpoint)
            and self.missed < self.missed_limit
            and self.inputs == self._received_inputs
            and self._followed == follows
            and self.controlword == self.word(-math.inf, wanted)
            and not self.is_not_followed(self.controlword, wanted)
        )

    def expected_rows(self, number: int) -> list[tuple[Any, ...]]:
        """Return the rows of driver.cyclic.EXPECTED that describe the frames of drive `number` if nothing changes."""
        exchange, word = self.exchange, canopen_frames.STATUSWORD.pack(self.statusword)
        decides = canopen_frames.STATUSWORD.pack(
            _STATE_BITS | (canopen_frames.FOLLOWS_SETPOINTS if exchange.tells_following else 0)
        )
        inputs = canopen_frames.INPUTS.pack(self.inputs), canopen_frames.INPUTS.pack(self.io.inputs)
        feedback, offset = exchange.feedback, exchange.feedback.offset(process_data.STATUSWORD)
        data, mask = bytearray(feedback.size), bytearray(feedback.size)
        if offset >= 0:
            data[offset : offset + 2], mask[offset : offset + 2] = word, decides
        position, identifier = feedback.offset(process_data.ACTUAL_POSITION), feedback.identifier
        rows = [expected_row(identifier, number, bytes(data), bytes(mask), position_at=position, status_at=offset)]
        if exchange.status is not None:
            beside = inputs if exchange.inputs == exchange.status else (b"", b"")
            rows.append(expected_row(exchange.status, number, word + beside[0], decides + beside[1], status_at=0))
        if exchange.inputs not in (None, exchange.status):
            rows.append(expected_row(exchange.inputs or 0, number, *inputs))
        alive = canopen_frames.NMT_STATE.pack(canopen_frames.OPERATIONAL)
        bits = bytes([canopen_frames.NMT_STATE_BITS if exchange.guarded else 0xFF])
        rows.append(expected_row(canopen_frames.HEARTBEAT + self.node, number, alive, bits, lives=exchange.heard))
        return rows

    def update_position(self, counts: int) -> None:
        """Update the actual position."""
        self.actual = counts
        self.position = self.scale.metres(counts)

    def on_sdo(self, data: bytes | bytearray, now: float) -> None:
        """Handle an SDO answer, which has eight bytes (CiA 301)."""
        if len(data) != 8:
            return
        if self.setup_listener is not None:
            self.setup_listener(canopen_frames.SDO_ANSWER + self.node, data)
        if self._pending.end(data):
            self.forget_requests()
        if data[1:3] == self.sdo_asked:
            self.sdo_answer, self.sdo_asked = bytes(data), None
        if canopen_frames.is_upload(data, canopen_frames.MODE_DISPLAY_UPLOADED) and self.awaits_mode:
            self._update_mode(data[4])
            self.poll_due = now + canopen_frames.POLL_PERIOD
        elif canopen_frames.is_upload(data, canopen_frames.STATUSWORD_UPLOADED):
            if not self._overtaken:
                self._on_statusword(data[4:6], now)
            self._statusword_asked = self._overtaken = False
            self.poll_due = now + canopen_frames.POLL_PERIOD
        elif canopen_frames.is_upload(data, canopen_frames.INPUTS_UPLOADED):
            if not self._inputs_overtaken:
                self.on_inputs(data[4:8], now)
        elif data[:4] == canopen_frames.OUTPUTS_REFUSED:
            code = int.from_bytes(data[4:8], "little")
            self.note_fault("state", 0, f"refuses its digital outputs, object 60FE:01 (SDO abort {code:08X})")
        elif canopen_frames.is_upload(data, canopen_frames.ERROR_REGISTER_UPLOADED) and now < self._register_until:
            self._register_until = -math.inf
            if data[4] == 0:
                self.error_code = 0  # CiA 301, 1001h: no error is present

    @property
    def awaits_mode(self) -> bool:
        """Whether the drive has power but does not show its mode yet. It is sent setpoints only when it does."""
        return not self.mode.shown and self.cyclic and self.state is PowerState.OPERATION_ENABLED

    def _update_mode(self, mode: int) -> None:
        """Check the mode display 6061h: 0 means that there is no mode yet; any other unexpected mode is a fault."""
        self.mode.shown = mode == self.exchange.mode
        if not self.mode.shown and mode:
            self.note_fault("state", 0, f"shows mode {mode} (object 6061), with power; expected {self.exchange.mode}")

    def request(self) -> bytes:
        """Return the next SDO request: for the statusword, for the mode display, or for both in turn."""
        both = self.exchange.polled or self.status_wanted
        for_mode = self.awaits_mode and self.mode.is_next(alone=not both)
        return canopen_frames.MODE_DISPLAY_UPLOAD if for_mode else canopen_frames.STATUSWORD_UPLOAD

    @property
    def holds(self) -> int | None:
        """Position [counts] that is sent to the drive instead of setpoints; None if setpoints are sent."""
        return self.held if self.mode.shown or self.held is not None else self.actual

    def on_status(self, data: bytes | bytearray, now: float) -> None:
        """Handle TPDO1, sent on change and every STATUS_PERIOD: the statusword, and the inputs if they are mapped
        there.
        """
        if self.exchange.inputs is not None and self.exchange.inputs == self.exchange.status:
            self.on_inputs(data[2:], now)
            data = data[:2]
        self._overtaken = self._statusword_asked
        self._on_statusword(data, now)

    def on_inputs(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002
        """Handle TPDO3, sent on change and every STATUS_PERIOD, or an SDO answer: the digital inputs."""
        (inputs,) = canopen_frames.INPUTS.unpack(data)
        self._inputs_overtaken = True
        self.update_inputs()
        self._received_inputs = inputs & self.io.inputs

    def start_inputs(self, inputs: int) -> None:
        """Set the digital inputs at the end of a set-up."""
        self.inputs = self._received_inputs = inputs & self.io.inputs

    def note_feedback(self) -> None:
        """Note that a feedback contains the inputs."""
        self._changed_inputs = 0

    def update_inputs(self) -> None:
        """Update the inputs by the received ones, except for those that have already changed since the last feedback.

        A pulse shorter than a cycle is then in two feedbacks, and has two edges.
        """
        before, kept = self.inputs, self._changed_inputs
        self.inputs = (before & kept) | (self._received_inputs & ~kept)
        self._changed_inputs |= before ^ self.inputs

    def _on_statusword(self, data: bytes | bytearray, now: float) -> None:
        (statusword,) = canopen_frames.STATUSWORD.unpack(data)
        self.update_status(statusword, now)

    def update_status(self, statusword: int, now: float) -> None:
        """Update the power state from a statusword received at time `now` [s]."""
        accept_statusword(self, statusword, now)
        state = canopen_frames.power_state(statusword)
        if state is None:
            self.note_fault("state", 0, f"statusword {statusword:04X} has no CiA 402 state")
            return
        if state is PowerState.OPERATION_ENABLED:
            self.powered_up = True
        if state not in _IN_FAULT:
            if self.state in _IN_FAULT:
                self.error_code = 0  # the error was the reason for the fault, which has ended
            self.reset_until = -math.inf
        self.state = state

    def end_cycle(self) -> DriveFault | None:
        """Check whether this cycle's frames came from two nodes with the same id, and update the inputs.

        A single node answers each SYNC once, and only while it is operational. Return a fault that was attributed to
        this drive although the second node caused it, otherwise None; the fault in `event` then reports the second
        node.
        """
        self.update_inputs()
        mistaken = self._answers_after.end_cycle(came=self.came)
        if self._answers_per_sync.from_two_nodes():
            self.note_fault("frame", 0, warning(self.node, "each SYNC has two positions"))
        if mistaken is not None:
            self.left_operational = self.status_wanted = False
            by = "one node has booted, or is not operational, while the other sends positions"
            self.event = self.make_fault("frame", 0, warning(self.node, by))
        return mistaken

    @property
    def shown_state(self) -> PowerState:
        """State of the drive for the feedback.

        A drive with power counts as "switched on" until it reports that it follows setpoints.
        """
        if not self.configured and self.state in (*_WITHOUT_POWER, PowerState.FAULT):
            return PowerState.NOT_READY_TO_SWITCH_ON
        waits = self.cyclic and (not self.mode.shown or (self.exchange.tells_following and not self.has_followed))
        return PowerState.SWITCHED_ON if waits and self.state is PowerState.OPERATION_ENABLED else self.state

    def on_emergency(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002
        """Handle an EMCY, which contains an error code; codes 00xxh report that an error has ended (CiA 301).

        Other errors persist as long as the error register is not 0.
        """
        code, register, _ = canopen_frames.EMERGENCY.unpack(data)
        if code & 0xFF00 == 0:
            self.error_code = self.error_code if register else 0
            return
        self.error_code = code
        if code & 0xFF00 == SENSOR_ERRORS and self.homes:
            self.homed = False  # an incremental encoder may have lost counts
        self.note_fault("emcy", code, f"emergency {describe_error(code, f', error register 0x{register:02X}')}")

    def start_error(self, code: int, *, in_error: bool) -> None:
        """Store the error that the drive had at the end of its set-up, with the error code 603Fh or 0.

        If the error register shows an error without a code, the code remains that of the last EMCY, if there was one.
        """
        if code or not in_error:
            self.error_code = code

    def on_heartbeat(self, data: bytes | bytearray, now: float) -> None:
        """Handle a heartbeat, an answer to node guarding, or a boot-up message."""
        (state,) = canopen_frames.NMT_STATE.unpack(data)
        if self.setup_listener is not None and state != canopen_frames.BOOT_UP:  # the set-up tests node guarding
            self.setup_listener(canopen_frames.HEARTBEAT + self.node, data)
        if self.exchange.guarded:
            state &= canopen_frames.NMT_STATE_BITS
        if self.exchange.heard:
            self.heard = now
        self.stopped = state == canopen_frames.STOPPED
        if self.stopped:
            self.forget_requests()  # in NMT stopped, a node answers no SDO (CiA 301)
        if state == canopen_frames.OPERATIONAL:
            self._operational = True
        elif state == canopen_frames.BOOT_UP:
            was_there = self.configured and self.missed < MISSED_STATUSES
            self.restarted, self.boots = True, self.boots + 1
            self.forget_requests()
            self.left_operational = self._operational = False
            self.state = PowerState.NOT_READY_TO_SWITCH_ON
            # This replaces an earlier event, which the restart explains.
            self.event = self.make_fault("state", 0, _RESTARTED)
            if was_there:  # otherwise positions may come from this drive, since some drives start by themselves
                self._answers_after.begin(self.event)
        elif self._operational:  # otherwise the drive sent the heartbeat before it was started
            self.leave_operational()
            self.note_fault("state", 0, f"has left NMT operational and is {_NMT_STATES.get(state, f'in {state:02X}')}")
            self._answers_after.begin(self.event)
        self.status_wanted = self.left_operational and not self.silent and state != canopen_frames.OPERATIONAL

    def leave_operational(self) -> None:
        """Record that the drive no longer receives PDOs.

        Its power state is unknown until it answers by SDO. A drive that had power counts as "switched on" until then:
        it no longer follows setpoints, but neither has it reported that it is without power.
        """
        self._operational = False
        self.left_operational, self.left_at = True, self.syncs
        self.outputs_sent = NOTHING_SENT  # the drive may have missed the last ones
        if self.state is PowerState.OPERATION_ENABLED:
            self.state = PowerState.SWITCHED_ON

    def has_missed_start(self, period: float) -> bool:
        """Whether the drive has not been seen in NMT operational since it was started, and has had time to answer a
        SYNC. `period` is the cycle period [s].
        """
        return not self._operational and self.missed * period > SILENT_AFTER

    @property
    def may_miss_pdos(self) -> bool:
        """Whether the drive may miss PDOs, so that controlwords must also be sent by SDO."""
        return self.left_operational or self.missed > 0

    def clear_faults(self, now: float) -> None:
        """Forget the latched event, but not a condition that persists, and give a fault reset time to take effect.

        A reset under way gets no more time: only a rising edge of bit 7 resets a fault (CiA 402-2, transition 15), so
        bit 7 must fall before the next reset. Nor does a request for the error register.
        """
        self._answers_after.forget()
        if self.configured:
            self.event = None
        resets = now < self.reset_until or self.controlword & canopen_frames.FAULT_RESET
        if self.state is PowerState.FAULT and not resets:
            self.reset_until = now + RESET_TIME
        if self.error_code and self.state not in _IN_FAULT:
            # After an EMCY without a following "error reset", only the error register shows whether the error is over.
            self.register_wanted = True
            if now >= self._register_until:
                self._register_until = now + REGISTER_TIME

    def word(self, now: float, wanted: canopen_frames.TargetState) -> int:
        """Return the controlword for the drive's next transition towards `wanted`, at time `now` [s]."""
        if self.state is PowerState.FAULT and now < self.reset_until:
            # Bit 7 stays set until the drive leaves fault: some drives sample it only every few cycles.
            return canopen_frames.FAULT_RESET
        if self.state is PowerState.QUICK_STOP_ACTIVE and self._is_at_rest(now):
            # With 605Ah = 5 to 8, the drive stays in this state with power (CiA 402-2, transition 12).
            # If "disable voltage" were sent before the drive is at rest, it would coast.
            return canopen_frames.DISABLE_VOLTAGE
        word = canopen_frames.controlword(self.state, wanted)
        if word != canopen_frames.ENABLE_OPERATION:
            return word
        interpolates = self.exchange.mode == process_data.INTERPOLATED_POSITION and self.cyclic
        if interpolates and self.state is PowerState.OPERATION_ENABLED:
            word |= canopen_frames.INTERPOLATE
        return word | self.mode_bits

    def is_not_followed(self, word: int, wanted: canopen_frames.TargetState) -> bool:
        """Whether the drive's state shows that a controlword has had no effect."""
        if self.state is PowerState.QUICK_STOP_ACTIVE:
            return word == canopen_frames.DISABLE_VOLTAGE
        if wanted is not PowerState.OPERATION_ENABLED:
            return self.state in _ENABLED_OR_ENABLING
        if self.state in _ENABLING_STATES or not self.cyclic:  # the state does not show the mode-specific bits
            return True
        if not word & canopen_frames.INTERPOLATE:
            return False
        if self.exchange.tells_following:
            return not self.statusword & canopen_frames.FOLLOWS_SETPOINTS
        return self.word_repeats < WORD_REPEATS

    def _is_at_rest(self, now: float) -> bool:
        """Whether the slider is at rest, judging by recent positions."""
        return now - self.stands_since >= STANDSTILL_TIME_S and self.missed == 0

    def stop_overdue_fault(self, wanted: str, seconds: float) -> DriveFault | None:
        """Return a fault if the drive still has power some time after a command such as "disable".

        `seconds` is the time since the command [s], and `wanted` is the name of the command. Return None for a drive
        in fault, because another fault already reports that drive.
        """
        if self.state in _WITHOUT_POWER or self.state in _IN_FAULT:
            return None
        text = self.describe_overdue_stop(str(self.state), "switch on disabled", wanted, seconds)
        if not self.statusword & canopen_frames.REMOTE:
            text += f"; it may be under local control: bit 9 (remote) of statusword {self.statusword:04X} is clear"
        return self.make_fault("timeout", 0, text)

    def find_fault(self, now: float, wanted: canopen_frames.TargetState) -> DriveFault | None:
        """Return the drive's fault at time `now` [s], or None; `wanted` is the commanded state."""
        if self.event is not None:
            return self.event
        if self.state in _IN_FAULT:
            if now >= self.reset_until:
                still = f", still {RESET_TIME:g} s after a fault reset" if self.reset_until > -math.inf else ""
                reason = f", error {describe_error(self.error_code, still)}" if self.error_code else still
                return self.make_fault("fault", self.error_code, f"{self.state}{reason}")
        elif (
            self.error_code and now >= self._register_until
        ):  # CiA 301: the error persists until the drive sends "error reset", code 00xxh
            return self.make_fault(
                "emcy", self.error_code, f"emergency {describe_error(self.error_code, ' is still in force')}"
            )
        elif silent := self.silence_fault(now):
            return silent
        elif now - self.status_heard > self.status_within:
            return self.make_fault("silent", 0, f"no statusword for {now - self.status_heard:.3g} s")
        elif (
            self.powered_up
            and wanted is PowerState.OPERATION_ENABLED
            and self.state is not PowerState.OPERATION_ENABLED
        ):
            return self.make_fault("state", 0, f"has left operation enabled by itself and is {self.state}")
        else:
            return self._following_fault(now, wanted)
        return None

    def _following_fault(self, now: float, wanted: canopen_frames.TargetState) -> DriveFault | None:
        """Return a fault if the drive shows no mode, or ignores setpoints according to bit 12 of its statusword.

        CiA 402-2 defines this bit for modes 7 and 8.
        """
        if (waited := self.mode.waited(now, awaited=self.awaits_mode)) is not None:
            return self.make_fault("state", 0, f"shows no mode (object 6061) {waited:.3g} s after it was enabled")
        enabled = wanted is self.state is PowerState.OPERATION_ENABLED
        meant_to = enabled and self.cyclic and self.mode.shown and self.exchange.tells_following
        if not meant_to or self.statusword & canopen_frames.FOLLOWS_SETPOINTS:
            self._followed = meant_to
            self.has_followed = self.has_followed or meant_to
            self._unfollowed_since = None
            return None
        if self._unfollowed_since is None:
            self._unfollowed_since = now
        if not self._followed and now - self._unfollowed_since <= FOLLOW_TIME:
            return None
        text = f"does not follow setpoints: bit 12 of statusword {self.statusword:04X} is clear"
        never = "" if self._followed else '; if the drive never sets bit 12, set accept_without = ["6041"]'
        return self.make_fault("state", 0, text + never)
