"""``igtl-gateway export``: a session in the formats of other programs."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from igtl_gateway.addon import NS_PER_S, ConfigError, GatewayError
from igtl_gateway.addon.processes import part_of
from igtl_gateway.addon.reading import SessionFile, check_recorded, with_state
from igtl_gateway.addon.streams import GAP_NS
from igtl_gateway.addon.terminal import (
    aligned,
    count_text,
    counted,
    file_name,
    natural,
    print_json,
    print_line,
)
from igtl_gateway.addons.exchange.account import ExportAccount, ExportedStream, first_few
from igtl_gateway.addons.exchange.export_verb_options import LEROBOT, LEROBOT_ROW
from igtl_gateway.addons.exchange.selection import bare_glob, sides_without_match
from igtl_gateway.addons.exchange.source import MESSAGES
from igtl_gateway.addons.exchange.targets import TARGETS, export_to

if TYPE_CHECKING:
    from igtl_gateway.addon.writing import Outputs

#: Above it, nanoseconds have no room.
MOST_GAP_S = 1e9


def run(options: argparse.Namespace) -> int:
    gap_ns, rate, outputs = _gap_ns(options), _rate(options), _outputs(options)
    if options.to == LEROBOT:
        return int(part_of(LEROBOT, "verb:run_lerobot")(options))
    if LEROBOT_ROW:
        part_of(LEROBOT, "verb:refuse_lerobot_options")(options)
    if len(options.files) != 1:
        found = counted(len(options.files), "recording") if options.files else "no recording"
        raise ConfigError(f"--to {options.to}: found {found}, expected one")
    options.file = options.files[0]
    if options.output is None:
        raise ConfigError("-o: found none, expected the file or directory to write")
    try:
        file_name(*TARGETS[options.to].suffixes)(str(options.output))
    except ConfigError as error:
        raise ConfigError(f"-o: {error}") from None
    with SessionFile.open(options.file) as file:
        faults = check_recorded([file], [bare_glob(glob) for glob in options.streams])
        faults += [
            f"--streams {glob}: the stream is recorded, but not on this side or by this link"
            for glob in sides_without_match(file, options.streams)
        ]
        try:
            account = export_to(options.to, with_state(file), options.output, options.streams, gap_ns, rate, outputs)
        except OSError as error:
            raise GatewayError(f"cannot write to {options.output}: {error.strerror or error}") from None
        reported = file.merge.reported if file.merge else ()
    account.notes += [*faults, *(f"reported by {each}" for each in reported)]
    written = sum(row.taken for row in account.rows)
    if not written:
        reasons = [f"{row.stream}: {row.why}" for row in account.rows if row.why]
        why = f" ({first_few(reasons, 3, '; ')})" if reasons else ""
        raise GatewayError(
            f"{options.file}: found no messages for {options.to}; see `igtl-gateway info`, and --streams{why}"
        )
    good = all(row.good for row in account.rows)
    if options.json:
        facts = {"file": str(options.file), "to": options.to, "out": str(options.output), "good": good}
        rows, parts = ([_as_json(row) for row in each] for each in (account.rows, account.parts))
        more = {"files": account.files, "rows": rows, "parts": parts, "others": account.others}
        print_json({**facts, **more, "notes": account.notes})
    else:
        _print(account, options)
        print_line(f"{options.output}: {count_text(written, 'message')} in {count_text(account.files, 'file')}")
        print_line(f"next: {_next_step(options)}")
    return 0 if good else 1


def _gap_ns(options: argparse.Namespace) -> int:
    """The largest gap to interpolate in, ns.  Raises ConfigError."""
    if options.max_gap is None:
        return GAP_NS
    if options.to == LEROBOT or not TARGETS[options.to].joins:
        joining = ", ".join(name for name, target in TARGETS.items() if target.joins)
        raise ConfigError(f"--max-gap: found --to {options.to}, expected {joining}: the option has no effect here")
    if not 0 <= options.max_gap < MOST_GAP_S:
        raise ConfigError(f"--max-gap: found {options.max_gap:g}, expected 0 or more, below {MOST_GAP_S:,.0f} s")
    return round(options.max_gap * NS_PER_S)


def _rate(options: argparse.Namespace) -> float:
    """The largest rate of a stream, Hz; 0 = the default of the format.  Raises ConfigError."""
    if options.rate is None:
        return 0.0
    if options.to == LEROBOT or not TARGETS[options.to].thins:
        thinning = ", ".join(name for name, target in TARGETS.items() if target.thins)
        raise ConfigError(f"--rate: found --to {options.to}, expected {thinning}: the option has no effect here")
    if not 1e-3 <= options.rate <= 1000:
        raise ConfigError(f"--rate: found {options.rate:g}, expected 0.001 to 1,000 Hz")
    return float(options.rate)


def _outputs(options: argparse.Namespace) -> Outputs:
    """How large outputs are written.  Raises ConfigError."""
    if options.outputs is None:
        return "full"
    if options.to == LEROBOT or not TARGETS[options.to].shortens:
        shortening = ", ".join(name for name, target in TARGETS.items() if target.shortens)
        raise ConfigError(f"--outputs: found --to {options.to}, expected {shortening}: the option has no effect here")
    outputs: Outputs = options.outputs
    return outputs


def _next_step(options: argparse.Namespace) -> str:
    tables = str(options.output / "*.parquet").replace("'", "''")
    query = f"SELECT parse_filename(filename) stream, count(*) FROM read_parquet('{tables}', filename=true) GROUP BY 1"
    count = shlex.quote(query) if any(sign in query for sign in '"$`\\!') else f'"{query}"'
    return TARGETS[options.to].next_step.format(out=shlex.quote(str(options.output)), count=count)


def _print(account: ExportAccount, options: argparse.Namespace) -> None:
    rows = [*account.rows, *(part for part in account.parts if part.left_out)]
    rows.sort(key=lambda row: natural(row.stream))
    table: list[Sequence[str]] = [("  stream", "found", "exported", "left out", "")]
    for row in rows:
        numbers = (f"{number:,}" for number in (row.declared, row.taken, row.left_out))
        why = row.why if row.unit == MESSAGES else f"{row.unit}: {row.why}"
        table.append((f"{' ' if row.good else '!'} {row.stream}", *numbers, why))
    print_line(*aligned(table, left=1, indent="", text=True))
    if account.others:
        others = count_text(sum(account.others.values()), "message")
        print_line(f"note: {others} of types that {options.to} cannot store: {first_few(sorted(account.others), 20)}")
    for note in account.notes:
        print_line(f"note: {note}")


def _as_json(row: ExportedStream) -> dict[str, Any]:
    return {
        "stream": row.stream,
        "type": row.type,
        "unit": row.unit,
        "found": row.declared,
        "exported": row.taken,
        "left_out": row.left_out,
        "failed": row.failed,
        "why": row.why,
    }
