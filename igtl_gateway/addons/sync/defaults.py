"""The defaults of the measurement of lags; without numpy, for the help of the command line."""

from __future__ import annotations

#: Search range to both sides, s.
MAX_LAG_S = 1.0
#: Highest cut-off of the low-pass, Hz: movements of hands and of robots in surgery are below.
CUT_OFF_HZ = 5.0
