"""Tasks on a cluster of Dask: one in this process for each run of the tests, and real ones with TLS on request."""

from __future__ import annotations

import datetime
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason='needs Dask: pip install "igtl-gateway[cohort]"')

from dask import distributed

from igtl_gateway.addons.cohort.results import Results
from igtl_gateway.addons.cohort.run import RunPlace, RunSettings
from igtl_gateway.addons.cohort.running import RunSummary, run_cohort
from igtl_gateway.addons.cohort.sources import locate
from igtl_gateway.base.errors import ConfigError, Unavailable
from tests.places import FIXTURES
from tests.timing import at_once

ON_REQUEST = pytest.mark.skipif(
    "IGTL_GATEWAY_CLUSTERS" not in os.environ, reason="opt-in: set IGTL_GATEWAY_CLUSTERS=1; takes half a minute"
)


def run(
    folder: Path, out: Path, where: RunPlace, progress: Callable[[RunSummary], None] = lambda summary: None
) -> RunSummary:
    return run_cohort(RunSettings("info", {}), locate([str(folder)]), Results(out), where, progress)


@pytest.fixture
def sessions(tmp_path: Path) -> Path:
    folder = tmp_path / "sessions"
    folder.mkdir()
    for number in range(4):
        shutil.copy(FIXTURES / "acquisition.mcap", folder / f"{number}.mcap")
    (folder / "text.mcap").write_text("not MCAP")
    return folder


def test_a_scheduler_gives_the_tables_of_this_machine(sessions: Path, tmp_path: Path) -> None:
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None, silence_logs=50
    ) as cluster:
        summary = run(sessions, tmp_path / "cluster", RunPlace(1, cluster.scheduler_address))
    assert dict(summary.ends) == {"ok": 4, "unsupported": 1}
    run(sessions, tmp_path / "here", RunPlace(1))
    tables = [Results(tmp_path / name).read("streams") for name in ("cluster", "here")]
    assert tables[0] == tables[1]


def test_files_of_tls_that_are_missing_are_named(sessions: Path, tmp_path: Path) -> None:
    where = RunPlace(1, "tls://127.0.0.1:9", str(sessions / "0.mcap"), str(sessions / "0.mcap"), "/nothing.pem")
    with pytest.raises(ConfigError, match=r"--tls-key /nothing\.pem: No such file"):
        run(sessions, tmp_path / "out", where)


def authority(folder: Path) -> list[Path]:
    """Make the certificate of an authority, and that of a member with its key."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    folder.mkdir()
    now = datetime.datetime.now(datetime.timezone.utc)
    names = [x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"{folder.name} {what}")]) for what in ("CA", "member")]
    keys = [ec.generate_private_key(ec.SECP256R1()) for _ in names]
    paths = [folder / "ca.pem", folder / "cert.pem", folder / "key.pem"]
    for number, (name, key) in enumerate(zip(names, keys, strict=True)):
        made = (
            x509.CertificateBuilder(names[0], name, key.public_key(), x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(days=1))
            .not_valid_after(now + datetime.timedelta(days=1))
            .add_extension(x509.BasicConstraints(number == 0, None), True)
            .sign(keys[0], hashes.SHA256())
        )
        paths[number].write_bytes(made.public_bytes(serialization.Encoding.PEM))
    form = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    paths[2].write_bytes(keys[1].private_bytes(*form))
    return paths


@contextmanager
def programs(folder: Path, tls: list[Path]) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Context manager: a scheduler and a worker in processes of their own; its address and process."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"tls://127.0.0.1:{free.getsockname()[1]}"
    names = ("--tls-ca-file", "--tls-cert", "--tls-key")
    words = ["--no-dashboard", *(word for pair in zip(names, map(str, tls), strict=True) for word in pair)]
    with open(folder / "log.txt", "wb") as log:
        commands = [
            ["distributed.cli.dask_scheduler", "--host", address, *words],
            ["distributed.cli.dask_worker", address, "--nthreads", "1", "--local-directory", str(folder), *words],
        ]
        started = [subprocess.Popen([sys.executable, "-m", *each], stdout=log, stderr=log) for each in commands]
        try:
            yield address, started[0]
        finally:
            for program in started:
                program.kill()
                program.wait()


@ON_REQUEST
def test_tls_between_programs_wrong_certificates_and_the_end_of_a_scheduler(sessions: Path, tmp_path: Path) -> None:
    ours, others = authority(tmp_path / "ours"), authority(tmp_path / "others")
    out = tmp_path / "out"

    def end(summary: RunSummary) -> None:
        if summary.done == 2:
            scheduler.send_signal(signal.SIGKILL)
            scheduler.wait()

    with programs(tmp_path, ours) as (address, scheduler):
        for files in (others, [ours[0], *others[1:]]):
            with at_once(), pytest.raises(Unavailable, match="found no scheduler of Dask"):
                run(sessions, out, RunPlace(1, address, *map(str, files)))
        with pytest.raises(Unavailable, match="the scheduler is gone; what is done is kept"):
            run(sessions, out, RunPlace(1, address, *map(str, ours)), end)
    with programs(tmp_path, ours) as (address, scheduler):
        summary = run(sessions, out, RunPlace(1, address, *map(str, ours)))
    assert (summary.files, summary.before) == (5, 2)
