"""What several verbs share: addresses, configuration, numbers for people, the end of the program by signal."""

from __future__ import annotations

import argparse
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from igtl_gateway.config import PROFILES, Config
from igtl_gateway.convert.frames import TfRequest
from igtl_gateway.convert.table import TO_ROS
from igtl_gateway.errors import ConfigError, DamagedRecording, UnsupportedRecording
from igtl_gateway.faults import FAULTS
from igtl_gateway.sessionfile import facts

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 18944


def address(text: str) -> tuple[str, int]:
    """``HOST:PORT``, ``:PORT``, ``PORT`` or ``HOST``; IPv6 hosts in brackets."""
    host, colon, port = text.rpartition(":")
    if text.startswith("[") and text.endswith("]"):
        host, colon, port = text, "", ""
    elif not colon:
        host, port = ("", text) if text.isdigit() else (text, "")
    if port and not (port.isdigit() and int(port) < 1 << 16):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected HOST:PORT with a port from 0 to 65535")
    return host.strip("[]") or DEFAULT_HOST, int(port) if port else DEFAULT_PORT


def add_addresses(
    parser: argparse.ArgumentParser, kind: Callable[[str], tuple[str, int]] = address, form: str = "HOST:PORT"
) -> None:
    """``--listen`` and ``--connect``, any number of each."""
    parser.add_argument(
        "--listen",
        type=kind,
        action="append",
        default=[],
        metavar=form,
        help=f"be an OpenIGTLink server here (default, if nothing is given: {DEFAULT_HOST}:{DEFAULT_PORT}); "
        "port 0 takes a free one",
    )
    parser.add_argument(
        "--connect",
        type=kind,
        action="append",
        default=[],
        metavar=form,
        help="be a client of the server there; reconnects for ever",
    )
    parser.add_argument(
        "--allow",
        action="append",
        default=[],
        metavar="CIDR",
        help="networks whose peers may connect (needed for --listen on other than loopback); 'any' for all",
    )


def addresses(options: argparse.Namespace) -> tuple[tuple[tuple[str, int], ...], tuple[tuple[str, int], ...]]:
    """(listen, connect) with the default server where neither is given."""
    listen, connect = tuple(options.listen), tuple(options.connect)
    return listen if listen or connect else ((DEFAULT_HOST, DEFAULT_PORT),), connect


def add_send(parser: argparse.ArgumentParser) -> None:
    """``--send``, any number of times."""
    parser.add_argument(
        "--send",
        action="append",
        default=[],
        metavar="TOPIC[=DEVICE[:TYPE]]",
        help="send a ROS topic to OpenIGTLink, as this device and type; may be repeated",
    )


def add_faults(parser: argparse.ArgumentParser, more: str = "") -> None:
    """``--fault`` and ``--seed``; ``more`` about the former."""
    rows = "; ".join(f"{row.name}={row.unit.value.replace('%', '%%')}: {row.meaning}" for row in FAULTS)
    parser.add_argument(
        "--fault",
        default="",
        metavar="NAME=VALUE[,…]",
        help=f"a bad line, on purpose.  {rows}.  TIME: 50ms, 2s, 1h; SHARE%%: 0.5%%{more}",
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of --fault: the same hits the same messages (%(default)s)"
    )


def add_routes(parser: argparse.ArgumentParser) -> None:
    """What a configuration file says too: topics, frames, messages and peers."""
    add_send(parser)
    parser.add_argument(
        "--tf-out",
        action="append",
        default=[],
        metavar="FRAME[,FRAME…]:BASE[=DEVICE[:TYPE]]",
        help="send ROS frames as seen from BASE, from /tf and /tf_static: one as TRANSFORM, several as TDATA",
    )
    parser.add_argument("--no-tf", action="store_true", help="do not publish poses on /tf")
    parser.add_argument(
        "--kinds",
        action="append",
        default=[],
        metavar="DEVICE=KIND[,KIND…]",
        help="publish only these messages of a device (* one level, ** any); +KIND: besides the usual ones",
    )
    parser.add_argument("--profile", choices=PROFILES, help="what the peers are (default: auto, by what they show)")
    parser.add_argument(
        "--peer",
        action="append",
        default=[],
        metavar="HOST:PORT=PROFILE",
        help="what the peer at an address is, or whoever connects there",
    )
    for way, text in (("in", "refuse messages of this type from peers"), ("out", "send peers none of this type")):
        parser.add_argument(
            f"--deny-{way}",
            action="append",
            default=[],
            metavar="TYPE",
            help=f"{text} (COMMAND, 'GET_*', '*' for all); may be repeated",
        )


def with_routes(config: Config, options: argparse.Namespace) -> Config:
    """``config`` with what the command line adds; its rows go before those of the file."""
    values = config.to_dict()
    values["to_igtl"] = [*map(_send_row, options.send), *values["to_igtl"]]
    values["tf_out"] = [*map(_tf_row, options.tf_out), *values["tf_out"]]
    kinds: dict[str, list[str]] = {}
    for device, named in map(_kinds_row, options.kinds):
        kinds.setdefault(device, []).extend(named)
    rows = [{"device": device, "kinds": named} for device, named in kinds.items()]
    values["to_ros"] = [*rows, *values["to_ros"]]
    values["peers"] = [*map(_peer_row, options.peer), *values["peers"]]
    values["deny_in"] = [*options.deny_in, *values["deny_in"]]
    values["deny_out"] = [*options.deny_out, *values["deny_out"]]
    if options.profile:
        values["profile"] = options.profile
    if options.no_tf:
        values["publish_tf"] = False
    return Config.from_dict(values)


def with_sends(config: Config, sends: list[str]) -> Config:
    """``config`` with a row in front for each ``TOPIC[=DEVICE[:TYPE]]``."""
    values = config.to_dict()
    return Config.from_dict(values | {"to_igtl": [*map(_send_row, sends), *values["to_igtl"]]})


def _send_row(text: str) -> dict[str, str]:
    topic, _, rest = text.partition("=")
    device, _, igtl_type = rest.partition(":")
    if not topic.startswith("/"):
        raise ConfigError(f"--send: found {text!r}, expected /topic, /topic=Device or /topic=Device:TYPE")
    return {"topic": topic, "device": device, "type": igtl_type}


def _tf_row(text: str) -> dict[str, Any]:
    request = TfRequest.parse(text)
    return {"frames": request.frames, "base": request.base, "device": request.device, "type": request.type}


def _kinds_row(text: str) -> tuple[str, list[str]]:
    device, equals, kinds = text.partition("=")
    known = {row.kind for row in TO_ROS}
    named = [kind.strip() for kind in kinds.split(",")]
    wrong = [kind for kind in named if kind.removeprefix("+") not in known]
    if not device or not equals or wrong:
        raise ConfigError(f"--kinds: found {text!r}, expected DEVICE=KIND[,KIND…] of {', '.join(sorted(known))}")
    return device, named


def _peer_row(text: str) -> dict[str, str]:
    place, _, profile = text.rpartition("=")
    if not place or profile not in PROFILES:
        raise ConfigError(f"--peer: found {text!r}, expected HOST:PORT=PROFILE, one of {', '.join(PROFILES)}")
    return {"at": place, "profile": profile}


def load_config(path: Path | None) -> Config:
    """The configuration of a file, or the default one."""
    return Config.from_toml(path) if path else Config()


def config_to_run(session: dict[str, str], path: Path | None = None) -> Config:
    """The configuration to run a recording with: of the file ``path`` if given, else the recorded one."""
    given = Config.from_toml(path) if path else None
    try:
        recorded = Config.from_dict(facts.configuration(session))
        # a file that does not speak of the watchers leaves them as they were that day
        return given.watched(recorded.watch) if given else recorded
    except (ConfigError, DamagedRecording) as error:
        if given:
            return given
        raise UnsupportedRecording(f"the recorded configuration cannot be used: {error}") from None


@contextmanager
def stop_event() -> Iterator[threading.Event]:
    """An event that SIGINT (Ctrl-C), SIGTERM and SIGHUP set; a second signal ends the program the hard way.

    The handler runs in the main thread, perhaps while that is inside ``event.wait`` and holds the event's lock:
    setting the event there would wait for that lock for ever.  So it writes to a pipe, and a thread sets the event.
    """
    event = threading.Event()
    reader, writer = os.pipe()

    def watch() -> None:
        if os.read(reader, 1):
            event.set()

    def on_signal(number: int, _frame: Any) -> None:
        os.write(writer, b"!")
        signal.signal(number, signal.SIG_DFL)

    watcher = threading.Thread(target=watch, name="igtl-signals", daemon=True)
    watcher.start()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    if before[signal.SIGHUP] is signal.SIG_IGN:  # nohup: the terminal may go
        del before[signal.SIGHUP]
    for number in before:
        signal.signal(number, on_signal)
    try:
        yield event
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(writer)
        watcher.join()
        os.close(reader)


def count_text(number: int, thing: str, things: str = "") -> str:
    """``1 message``, ``1,234 messages``."""
    return f"{number:,} {thing if number == 1 else things or thing + 's'}"


def size_text(number: float) -> str:
    """Bytes for people: ``812 B``, ``9.6 MB``."""
    for unit in ("B", "kB", "MB", "GB"):
        if number < 1000 or unit == "GB":
            return f"{number:.0f} {unit}" if unit == "B" else f"{number:.1f} {unit}"
        number /= 1000
    raise AssertionError
