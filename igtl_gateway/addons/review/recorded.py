"""Review of a recording: its file, the material in it, and the review."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from igtl_gateway.addon import ConfigError, GatewayError
from igtl_gateway.addon.messages import scale
from igtl_gateway.addon.reading import (
    Heads,
    Mark,
    RecordedStamps,
    SessionFile,
    config_to_run,
    marks_of,
    rows_of,
    with_state,
)
from igtl_gateway.addons.review import Material, Review, StitchReview, Thresholds, review_of
from igtl_gateway.addons.review.choices import ReviewSelection


def review_recording(path: Path, selection: ReviewSelection, thresholds: Thresholds) -> tuple[Review, int]:
    """Return the review of a recording, and its first gateway time (UTC ns).

    Raises GatewayError if it has no cloud or no plan, ConfigError if it does not have the requested ones.
    """
    with SessionFile.open(path) as file:
        return review_session(file, selection, thresholds), file.start_ns


def review_session(file: SessionFile, selection: ReviewSelection, thresholds: Thresholds) -> Review:
    """Return the review of an open recording; see `review_recording`."""
    unit_m = scale(config_to_run(file.session).ros_unit, "m")
    material = Material(selection.plan, selection.cloud, selection.tool, selection.clouds, unit_m)
    stamps, heads = RecordedStamps(file), Heads()
    for rows in rows_of(with_state(file), heads):
        if stamps:
            for entry in rows.entries(heads):
                material.take(stamps.entry(entry))
        else:
            material.take_rows(rows, heads)
    try:
        return named_by_marks(review_of(material, thresholds), marks_of(file))
    except ConfigError:
        raise
    except GatewayError as error:
        raise GatewayError(f"{file.path}: {error}") from None


def named_by_marks(review: Review, marks: Sequence[Mark]) -> Review:
    """Return the review with the phases of the session as names of the stitches of the last plan.

    A stitch has the shortest phase in which the tool reached its entry; otherwise one of its own label.
    """
    phases = [mark for mark in marks if mark.end_ns is not None]
    phases.sort(key=lambda mark: mark.last_ns - mark.time_ns)
    if not phases:
        return review
    named = tuple(replace(each, mark=_phase_of(each, phases)) for each in review.last.stitches)
    return replace(review, plans=(*review.plans[:-1], replace(review.last, stitches=named)))


def _phase_of(stitch: StitchReview, phases: Sequence[Mark]) -> str:
    at = stitch.entry.executed
    for phase in phases:
        if at and at.reached and phase.time_ns <= at.stamp_ns <= phase.last_ns:
            return phase.label
    return next((phase.label for phase in phases if phase.label == stitch.label), "")


def checked_thresholds(values: Mapping[str, float], clouds: int, name: Callable[[str], str] = str) -> Thresholds:
    """Return the thresholds.  Raises ConfigError, with the name that ``name`` gives to a threshold."""
    for each, value in values.items():
        if not 0 < value < math.inf:
            raise ConfigError(f"{name(each)}: found {value}, expected a number above 0")
    if clouds < 1:
        raise ConfigError(f"{name('clouds')}: found {clouds}, expected 1 or more")
    limits = Thresholds(**values)
    if limits.look_mm > limits.wrong_mm:
        raise ConfigError(
            f"{name('look_mm')}: found {limits.look_mm}, expected at most {name('wrong_mm')}, {limits.wrong_mm}"
        )
    return limits
