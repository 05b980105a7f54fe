"""What a person reads has one form: durations, sizes and rates come from ``base/quantities`` only.

Strategy: in the f-strings of the sources no number that is rounded or grouped stands in front of a unit.  A setting in
the unit of its option (``{limit_s:g} s``) is not one.  What has to keep its unit or its digits is listed with why.
"""

from __future__ import annotations

import re

from tests.places import FIXTURES

ROOT = FIXTURES.parent
#: The messages that scenarios send, and the tables of the bench, have fixed units.
_SENT = ("lab/igtl_gateway_lab/simulate", "lab/igtl_gateway_lab/demo", "lab/igtl_gateway_lab/bench")
_UNIT = r"(?:ns|µs|ms|s|min|h|d|days|Hz|kHz|B|kB|MB|GB|TB|KiB|MiB|GiB|[kMG]B/s)"
#: A value with a format that rounds or groups it, and a unit behind it.
_BY_HAND = re.compile(r"\{[^{}]*:[-+ <>^=]*[0-9]*,?(?:\.[0-9]+[fge]|,[0-9]*)?(?<!:)\} ?" + _UNIT + r"(?!\w)")
#: File → the values in it that are right as they are.
RIGHT_AS_IT_IS = {
    # the formatters
    "igtl_gateway/base/quantities.py": 8,
    # exact times, for who looks for this one sample
    "igtl_gateway/addons/exchange/scene_out.py": 2,
    "igtl_gateway/addons/lerobot": 40,
    "igtl_gateway/addons/resim": 5,
    "igtl_gateway/testing/compare.py": 1,
    # in the unit of the setting, the limit or the interval beside it
    "igtl_gateway/addons/deidentify/pseudonyms.py": 1,
    "igtl_gateway/addons/exchange/export_verb_run.py": 1,
    "igtl_gateway/addons/exchange/scene_tracks.py": 2,
    "igtl_gateway/addons/sync": 20,
    "igtl_gateway/addons/view/lag_drawing.py": 2,
    "igtl_gateway/config/faults.py": 1,
    "igtl_gateway/doctor/host_checks.py": 6,
    "igtl_gateway/gateway": 8,
    "igtl_gateway/replay/diff.py": 2,
}


def made_by_hand(text: str) -> list[str]:
    """Return what is found in a source."""
    return [found[0] for found in _BY_HAND.finditer(text)]


def test_no_duration_size_or_rate_is_made_by_hand() -> None:
    found: dict[str, list[str]] = {}
    for path in sorted((*ROOT.glob("igtl_gateway/**/*.py"), *ROOT.glob("lab/**/*.py"))):
        name = path.relative_to(ROOT).as_posix()
        if not name.startswith(_SENT) and (values := made_by_hand(path.read_text("utf-8"))):
            home = next((each for each in RIGHT_AS_IT_IS if name.startswith(each)), name)
            found[home] = found.get(home, []) + values
    more = {home: each for home, each in found.items() if len(each) > RIGHT_AS_IT_IS.get(home, 0)}
    assert not more, "found more than the table has: use duration_text, size_text, rate_text, moment_text"
    assert found.keys() == RIGHT_AS_IT_IS.keys()


def test_what_is_made_by_hand_is_found() -> None:
    for text in ('f"{passed_s:.1f} s"', 'f"took {ns / 1e6:+.3f} ms,"', "f'{size:,} B'", 'f"{rate:6.2f}Hz"'):
        assert made_by_hand(text), text
    for text in ('f"{limit_s:g} s"', 'f"{duration_text(ns)} later"', 'f"{count:,} streams"', 'f"{length:.2f} mm"'):
        assert not made_by_hand(text), text
