"""``cohort export``: one training set of all sessions, whose jobs run in programs of their own, here or on Dask."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from igtl_gateway.addon import ConfigError, GatewayError
from igtl_gateway.addon.processes import part_of
from igtl_gateway.addons.cohort import ends
from igtl_gateway.addons.cohort.run import KnownFile, RunPlace, RunSettings
from igtl_gateway.addons.cohort.running import replies_of
from igtl_gateway.addons.cohort.sources import Located, locate

LEROBOT = "lerobot"


def run_export(options: argparse.Namespace, where: RunPlace) -> int:
    """Write or extend a data set of all sources; return the exit code.

    Raises ConfigError for an object of a store, and what ``export --to lerobot`` raises.
    """
    files = locate(options.sources)
    remote = [each.shown for each in files if "://" in each.name]
    if remote:
        raise ConfigError(f"cohort export: found {remote[0]}, expected files of this machine: copy the objects first")
    found = {each.name: each for each in files}
    work = RunSettings(ends.EXPORT, {}, options.limit, options.memory_mib << 20, options.timeout)
    reply_of = part_of(LEROBOT, "export:Reply")

    def do(jobs: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        todo = {
            number: KnownFile(
                found.get(job.path, Located(job.path, 0, "")), "", {"job": job.to_dict(), "number": number}
            )
            for number, job in enumerate(jobs)
        }
        for item, reply in replies_of(work, list(todo.values()), where):
            error = None if reply["status"] == ends.OK else _error(reply)
            rows = reply.get("rows", {}).get(ends.EXPORT, [{}])
            yield int(item.part["number"]), reply_of(rows[0], error)

    return int(part_of(LEROBOT, "verb:export_set")(options, [Path(each.name) for each in files], do))


def _error(reply: dict[str, Any]) -> GatewayError:
    text = reply["error"] or reply["status"].replace("_", " ")
    return ConfigError(text) if reply["status"] == ends.NOTHING else GatewayError(text)
