"""An export as a test compares it with that of another way: the error, the files and the account."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.state_before import with_state


def exported(write: Callable[..., ExportAccount], path: Path, out: Path, *given: object) -> tuple[object, ...]:
    """Export a recording by ``write(file, out, *given)``.

    Returns: the error or "", name → bytes of the files, and the account.
    """
    account: ExportAccount | None = None
    why = ""
    try:
        with SessionFile.open(path) as file:
            account = write(with_state(file), out, *given)
    except GatewayError as error:
        why = f"{type(error).__name__}: {error}"
    files = {each.name: each.read_bytes() for each in out.iterdir()} if out.exists() else {}
    facts = (
        (account.rows, account.files, account.notes, account.others, list(account.senders.notes())) if account else ()
    )
    return why, files, facts
