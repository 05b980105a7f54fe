"""``export --to lerobot``: recording and recipe → data set."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from igtl_gateway.addon.reading import open_recording
from igtl_gateway.addons.lerobot.card_streams import Facts, stream_facts
from igtl_gateway.addons.lerobot.frames import Plan, build
from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.addons.lerobot.writing import check_out, write_data_set


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written.

    Attributes:
        plan: the frames.
        streams: what was found about the streams.
        files: number of files.
    """

    plan: Plan
    streams: list[Facts]
    files: int


def export_lerobot(path: Path, recipe_path: Path, out: Path) -> Exported:
    """Write a data set to a new or empty directory.

    Raises ConfigError for a recipe that does not fit, GatewayError, OSError.
    """
    recipe = read_recipe(recipe_path)
    check_out(out)
    with open_recording(path) as recording:
        plan = build(recording, recipe)
        streams = stream_facts(recording, plan)
        files = write_data_set(plan, out, recipe_path, streams)
    return Exported(plan, streams, files)
