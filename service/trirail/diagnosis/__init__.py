"""Checks of a configuration for values that are valid but probably not intended, and measurement of loop timing."""

from trirail.diagnosis.check import Check, Verdict
from trirail.diagnosis.configured import diagnose, failed_checks
from trirail.diagnosis.stopping import Stops, stops

__all__ = ["Check", "Stops", "Verdict", "diagnose", "failed_checks", "stops"]
