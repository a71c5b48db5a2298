"""Descriptions of ODrive errors with remedies, from the ODrive manual, chapter "Error Codes", firmware 0.6."""

from __future__ import annotations

from typing import Final

from trirail_drivers.odrive.cansimple import Error

_TUNING: Final = "check load, limits and gains"
_SUPPLY: Final = "check supply and brake resistor: braking feeds energy back"
_WORDS: Final = {
    Error.INITIALIZING: ("it is starting, or lost power while starting", "wait; reset; if it stays, restart the drive"),
    Error.SYSTEM_LEVEL: ("its firmware failed", "restart it; update its firmware"),
    Error.TIMING_ERROR: ("its processor is overloaded", "switch off features that are not needed"),
    Error.MISSING_ESTIMATE: ("it does not know where its motor is", "calibrate the encoder; check its cable"),
    Error.BAD_CONFIG: ("its configuration is not valid", "check it with odrivetool"),
    Error.DRV_FAULT: ("its gate driver failed", "check the motor for a short circuit; else the drive is broken"),
    Error.MISSING_INPUT: ("it got no setpoint", "check its input mode"),
    Error.DC_BUS_OVER_VOLTAGE: ("supply voltage too high", _SUPPLY),
    Error.DC_BUS_UNDER_VOLTAGE: ("supply voltage too low", "check the supply and its cable"),
    Error.DC_BUS_OVER_CURRENT: ("it draws too much current from the supply", _TUNING),
    Error.DC_BUS_OVER_REGEN_CURRENT: ("it feeds too much current back", _SUPPLY),
    Error.CURRENT_LIMIT_VIOLATION: ("motor current beyond its limit", _TUNING),
    Error.MOTOR_OVER_TEMP: ("motor too hot", "let it cool down; check load and airflow"),
    Error.INVERTER_OVER_TEMP: ("power stage too hot", "let it cool down; check load and airflow"),
    Error.VELOCITY_LIMIT_VIOLATION: ("velocity beyond its limit", _TUNING),
    Error.POSITION_LIMIT_VIOLATION: ("position beyond its limit", "check its limits and counts_per_metre"),
    Error.REQUESTED_CURRENT_TOO_HIGH: ("requested motor current too high", _TUNING),
    Error.WATCHDOG_TIMER_EXPIRED: (
        "no setpoint came in time",
        "was the service stopped or too slow? cable, terminators; trirail doctor",
    ),
    Error.ESTOP_REQUESTED: ("its emergency stop was triggered", "check the emergency stop's input and wiring"),
    Error.SPINOUT_DETECTED: (
        "motor and encoder disagree",
        "check the encoder; calibrate its offset",
    ),
    Error.BRAKE_RESISTOR_DISARMED: ("its brake resistor is off", "check the resistor and its cable"),
    Error.THERMISTOR_DISCONNECTED: ("its thermistor is missing", "check the thermistor and its cable"),
    Error.CALIBRATION_ERROR: ("its calibration failed", "calibrate it again, with the motor free to turn"),
}


def describe_errors(errors: int) -> str:
    """Describe error bits [0, FFFFFFFFh]: the hexadecimal number, and the name, meaning and remedy of each error."""
    known = [error for error in Error if errors & error]
    unknown = errors & ~sum(Error)
    names = [f"{error.name} ({_WORDS[error][0]})" for error in known]
    remedies = dict.fromkeys(_WORDS[error][1] for error in known)
    if unknown:
        names.append(f"{unknown:08X}h (of a firmware that is not known here)")
        remedies["see the drive's manual"] = None
    return f"0x{errors:08X} {', '.join(names)}; {'; '.join(remedies)}"
