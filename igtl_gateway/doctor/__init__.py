"""Diagnosis of a session by rules: of connected peers (``doctor``) or of a recording (``doctor FILE``).

All entries go through one `Observer`, which counts and measures.  The rules of one table (`rules.RULES`) check its
observations with pure functions.  A finding has the number and severity of its rule, what was found, what to do, and
the document with the requirement.
"""

from igtl_gateway.doctor.observer import Observer
from igtl_gateway.doctor.report import DoctorReport
from igtl_gateway.doctor.rules import RULES, Rule, RuleFinding, Severity

__all__ = ["RULES", "DoctorReport", "Observer", "Rule", "RuleFinding", "Severity"]
