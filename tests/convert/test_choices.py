"""The names that the command line shows before it loads the tables that they are from."""

from __future__ import annotations

from igtl_gateway.convert import choices, profiles, table, units


def test_what_a_user_chooses_from_is_what_the_tables_have() -> None:
    assert list(choices.PROFILES) == [profile.name for profile in profiles.PROFILES]
    assert list(choices.UNITS) == list(units.UNITS)
    assert list(choices.KINDS) == sorted({row.kind for row in table.TO_ROS})


def test_the_choice_that_is_detected_is_no_profile() -> None:
    assert choices.AUTO not in choices.PROFILES
