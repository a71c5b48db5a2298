"""What a configuration is likely to mean otherwise than it says: each check is a function of the configuration."""

from trirail.diagnosis.check import Check, Verdict
from trirail.diagnosis.configured import diagnose, failed_checks
from trirail.diagnosis.stopping import Stops, stops

__all__ = ["Check", "Stops", "Verdict", "diagnose", "failed_checks", "stops"]
