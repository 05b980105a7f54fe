"""``igtl-gateway export --to lerobot``: a starting recipe, a data set, or the check of one."""

from __future__ import annotations

import argparse
from typing import Any

from igtl_gateway.addon import ConfigError, GatewayError
from igtl_gateway.addon.processes import extras
from igtl_gateway.addon.reading import open_recording
from igtl_gateway.addon.terminal import aligned, count_text, print_json, print_line
from igtl_gateway.addon.writing import check_target, write_error, write_text, written
from igtl_gateway.addons.lerobot.options import LEROBOT

_OPTIONS = {"recipe": "--recipe", "write_recipe": "--write-recipe", "check": "--check"}


def refuse_lerobot_options(options: argparse.Namespace) -> None:
    """Raise ConfigError for options of this format with another one."""
    for name, text in _OPTIONS.items():
        if getattr(options, name) is not None:
            raise ConfigError(f"{text}: found it with --to {options.to}, expected --to {LEROBOT}")


def run_lerobot(options: argparse.Namespace) -> int:
    """Write a recipe or a data set, or check one; return the exit code."""
    given = [text for name, text in _OPTIONS.items() if getattr(options, name) is not None]
    if len(given) != 1:
        raise ConfigError(f"--to {LEROBOT}: found {' and '.join(given) or 'none'}, expected one of "
                          f"{', '.join(_OPTIONS.values())}")  # fmt: skip
    if (options.output is not None) != (options.recipe is not None):
        raise ConfigError("-o: found it or --recipe alone, expected both")
    if options.streams:
        raise ConfigError(f"--streams: found it with --to {LEROBOT}, expected the streams in the recipe")
    with extras.in_use(LEROBOT):
        if options.write_recipe:
            return _write_recipe(options)
        return _check(options) if options.check else _export(options)


def _write_recipe(options: argparse.Namespace) -> int:
    from igtl_gateway.addons.lerobot.drafting import draft

    if options.write_recipe.exists():
        raise ConfigError(f"{options.write_recipe}: exists already, expected a new file")
    check_target(options.write_recipe, overwrite=False)
    with open_recording(options.file) as recording:
        text = draft(recording)
    with written(options.write_recipe) as path:
        write_text(path, text)
    if options.json:
        print_json({"file": str(options.file), "to": LEROBOT, "recipe": str(options.write_recipe)})
    else:
        print_line(f"{options.write_recipe}: a recipe to start with; edit task, and the names of the features")
    return 0


def _check(options: argparse.Namespace) -> int:
    from igtl_gateway.addons.lerobot.comparing import check

    found, findings = check(options.check, options.file)
    if options.json:
        print_json({"file": str(options.file), "to": LEROBOT, "check": str(options.check), "findings": findings})
    else:
        for each in findings:
            print_line(f"! {each}")
        size = "" if found is None else (
            f"{count_text(sum(each.length for each in found.episodes), 'frame')} in "
            f"{count_text(len(found.episodes), 'episode')}, "
        )  # fmt: skip
        print_line(f"{options.check}: {size}{count_text(len(findings), 'finding')}")
    return int(bool(findings))


def _export(options: argparse.Namespace) -> int:
    from igtl_gateway.addons.lerobot.export import export_lerobot
    from igtl_gateway.addons.lerobot.splits import MOST_LISTED, divided, listed

    try:
        done = export_lerobot(options.file, options.recipe, options.output)
    except OSError as error:
        raise write_error(options.output, error) from None
    except GatewayError as error:
        text = str(error)
        known = str(options.recipe), str(options.file), str(options.output), "cannot write"
        raise type(error)(text if text.startswith(known) else f"{options.recipe}: {text}") from None
    plan = done.plan
    facts: list[dict[str, Any]] = [
        {
            "feature": each.samples.row.name,
            "stream": each.samples.row.stream,
            "rule": each.samples.row.rule,
            "messages": each.samples.count,
            "unusable": each.samples.unusable,
            "used": each.used,
            "interpolated": each.interpolated,
            "held": each.held,
        }
        for each in done.streams
    ]
    if options.json:
        print_json(
            {
                "file": str(options.file), "to": LEROBOT, "out": str(options.output), "format": plan.recipe.format,
                "clock": plan.clock, "episodes": len(plan.episodes), "frames": plan.frame_count, "files": done.files,
                "notes": plan.joined.notes,
                "demonstrations": plan.demonstrations, "empty": plan.empty, "cuts": plan.cuts, "splits": plan.splits,
                "left_out": plan.left_out, "streams": facts,
            }
        )  # fmt: skip
        return 0
    names = ("feature", "stream", "rule", "messages", "unusable", "used", "interpolated", "held")
    rows = [names, *(tuple(_cell(each[name]) for name in names) for each in facts)]
    print_line(*aligned(rows, left=3))
    for note in plan.joined.notes:
        print_line(f"note: {note}")
    for why, number in plan.left_out.items():
        print_line(f"note: {count_text(number, 'frame')} left out: {why}")
    if plan.empty:
        print_line(f"note: demonstrations without a frame: {listed(plan.empty)}, of {plan.demonstrations:,}")
    parts = divided(plan.owners)
    for owner, episodes in list(parts.items())[:MOST_LISTED]:
        numbers = f"episodes {episodes[0]} to {episodes[-1]}"
        print_line(f"note: demonstration {owner} has a gap above a tolerance, or is too long: {numbers}")
    if len(parts) > MOST_LISTED:
        print_line(f"note: {len(parts) - MOST_LISTED:,} more demonstrations that are several episodes")
    if plan.recipe.splits:
        print_line("splits: " + ", ".join(f"{name} has the episodes {text}" for name, text in plan.splits.items()))
    print_line(
        f"{options.output}: LeRobot {plan.recipe.format}, {count_text(plan.frame_count, 'frame')} in "
        f"{count_text(len(plan.episodes), 'episode')}, clock: {plan.clock}"
    )
    return 0


def _cell(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else str(value)
