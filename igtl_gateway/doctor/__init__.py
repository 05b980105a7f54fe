"""What is wrong with a session, by rules: of a peer that is connected now (``doctor``) or of a recording (``lint``).

Entries, wherever they come from, go through one `Observer`, which counts and measures.  What it has seen is judged by
the rules of one table (`rules.RULES`), pure functions that give findings: a rule's number, severity, what was found,
what to do, and where it is written.
"""

from igtl_gateway.doctor.observer import Observer
from igtl_gateway.doctor.report import DoctorReport
from igtl_gateway.doctor.rules import RULES, Rule, RuleFinding, Severity

__all__ = ["RULES", "DoctorReport", "Observer", "Rule", "RuleFinding", "Severity"]
