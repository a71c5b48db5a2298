"""The words that processes and clients share: what the robot can be doing."""

from __future__ import annotations

from enum import StrEnum


class Mode(StrEnum):
    """What the robot is doing."""

    DISABLED = "disabled"
    ENABLING = "enabling"
    HOMING = "homing"
    HOLDING = "holding"
    MOVING = "moving"
    STOPPING = "stopping"
    FAULT = "fault"


MODES = tuple(Mode)
"""In the order in which records number them."""
