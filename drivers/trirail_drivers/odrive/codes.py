"""ODrive's errors in words, and what to do about them: from its manual, chapter "Error Codes", firmware 0.6."""

from __future__ import annotations

from typing import Final

from trirail_drivers.odrive.cansimple import Error

_TUNING: Final = "look at load, limits and gains"
_SUPPLY: Final = "look at the supply and at the brake resistor, for braking feeds back"
_WORDS: Final = {
    Error.INITIALIZING: ("it is starting", "wait; if it stays, restart the drive"),
    Error.SYSTEM_LEVEL: ("its firmware failed", "restart it; update its firmware"),
    Error.TIMING_ERROR: ("its processor is too slow for what it is to do", "switch off what of it is not needed"),
    Error.MISSING_ESTIMATE: ("it does not know where its motor is", "calibrate the encoder; look at its cable"),
    Error.BAD_CONFIG: ("its configuration is not valid", "look at it with odrivetool"),
    Error.DRV_FAULT: ("its gate driver failed", "look for a short circuit at the motor; else the drive is broken"),
    Error.MISSING_INPUT: ("it was given no setpoint", "look at its input mode"),
    Error.DC_BUS_OVER_VOLTAGE: ("supply voltage too high", _SUPPLY),
    Error.DC_BUS_UNDER_VOLTAGE: ("supply voltage too low", "look at the supply and its cable"),
    Error.DC_BUS_OVER_CURRENT: ("it takes too much current from the supply", _TUNING),
    Error.DC_BUS_OVER_REGEN_CURRENT: ("it feeds too much current back", _SUPPLY),
    Error.CURRENT_LIMIT_VIOLATION: ("motor current beyond its limit", _TUNING),
    Error.MOTOR_OVER_TEMP: ("motor too hot", "let it cool down; look at load and air"),
    Error.INVERTER_OVER_TEMP: ("power stage too hot", "let it cool down; look at load and air"),
    Error.VELOCITY_LIMIT_VIOLATION: ("velocity beyond its limit", _TUNING),
    Error.POSITION_LIMIT_VIOLATION: ("position beyond its limit", "look at its limits and at counts_per_metre"),
    Error.WATCHDOG_TIMER_EXPIRED: (
        "no setpoint came in time",
        "was the service stopped or too slow? cable, terminators; trirail doctor",
    ),
    Error.ESTOP_REQUESTED: ("its emergency stop was asked for", "look at its emergency stop's input and wiring"),
    Error.SPINOUT_DETECTED: (
        "motor and encoder disagree",
        "look at the encoder; calibrate its offset",
    ),
    Error.BRAKE_RESISTOR_DISARMED: ("its brake resistor is off", "look at the resistor and its cable"),
    Error.THERMISTOR_DISCONNECTED: ("its thermistor is missing", "look at the thermistor and its cable"),
    Error.CALIBRATION_ERROR: ("its calibration failed", "calibrate it anew, with the motor free to turn"),
}


def words(errors: int) -> str:
    """Return error bits [0, FFFFFFFFh] as hexadecimal number with their names, what they mean, and remedies."""
    known = [error for error in Error if errors & error]
    unknown = errors & ~sum(Error)
    said = [f"{error.name} ({_WORDS[error][0]})" for error in known]
    remedies = dict.fromkeys(_WORDS[error][1] for error in known)
    if unknown:
        said.append(f"{unknown:08X}h (of a firmware that is not known here)")
        remedies["see the drive's manual"] = None
    return f"0x{errors:08X} {', '.join(said)}; {'; '.join(remedies)}"
