"""The tasks of a run on the workers of Dask, behind a scheduler that runs elsewhere."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from igtl_gateway.addon import ConfigError, SystemClock, Unavailable, UnsupportedRecording
from igtl_gateway.addon.processes import extras
from igtl_gateway.addon.untrusted import open_file
from igtl_gateway.addons.cohort.run import KnownFile, Reply, Runner, RunPlace, RunSettings
from igtl_gateway.addons.cohort.sources import digest
from igtl_gateway.addons.cohort.task import failed, job_of, run_task

if TYPE_CHECKING:
    from dask.distributed import Client

_CONNECT_S = 20


@contextmanager
def cluster(where: RunPlace) -> Iterator[Runner]:
    """Context manager: the workers of Dask behind a scheduler.  Raises Unavailable."""
    try:
        from dask import distributed
    except ImportError as error:
        raise Unavailable(extras.missing("dask", error)) from None
    for name in list(logging.root.manager.loggerDict):  # what it logs of a lost connection is in our errors
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)

    def do(work: RunSettings, todo: Sequence[KnownFile]) -> Iterator[tuple[KnownFile, Reply]]:
        moment = str(SystemClock().utc_ns())  # Dask answers a key that it knows from memory
        keys = [
            f"igtl-{work.verb}-{digest(file.name, file.mark, work.text, str(dict(part)), moment)}"
            for file, _, part in todo
        ]
        jobs = [job_of(work, item) for item in todo]
        found = client.map(run_task, jobs, memory=work.memory, timeout_s=work.timeout_s, key=keys)
        futures = dict(zip(found, todo, strict=True))
        for future in distributed.as_completed(found, raise_errors=False):
            item = futures.pop(future)
            try:
                if future.status in ("cancelled", "lost"):
                    raise distributed.CancelledError
                reply = failed(future.exception()) if future.status == "error" else dict(future.result())
            except (distributed.CancelledError, OSError):  # at any moment
                raise Unavailable(
                    f"{where.scheduler}: the scheduler is gone; what is done is kept, run again"
                ) from None
            yield item, reply
            future.release()

    with _client(where) as client:
        yield do


@contextmanager
def _client(where: RunPlace) -> Iterator[Client]:
    from dask.distributed import Client, Security

    security = None
    for option, name in (("--tls-ca", where.tls_ca), ("--tls-cert", where.tls_cert), ("--tls-key", where.tls_key)):
        if name:
            try:
                open_file(Path(name)).close()
            except UnsupportedRecording as error:
                raise ConfigError(f"{option} {error}") from None
    if where.tls_ca:
        security = Security(
            tls_ca_file=where.tls_ca,
            tls_client_cert=where.tls_cert,
            tls_client_key=where.tls_key,
            require_encryption=True,
        )
    try:
        client = Client(where.scheduler, security=security, timeout=_CONNECT_S)
    except (OSError, ValueError, TypeError) as error:
        raise Unavailable(
            f"{where.scheduler}: found no scheduler of Dask ({str(error).partition(chr(10))[0]})"
        ) from None
    with client:
        yield client
