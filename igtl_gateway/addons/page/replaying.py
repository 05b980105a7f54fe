"""The process of a replay that the page steers.

``python -m igtl_gateway.addons.page.replaying``: the first line of its input has the options of the replay as JSON,
each further one a command.  Each line of its output has as JSON a ``line`` of text, or the ``state`` of the replay.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from igtl_gateway.addon import NS_PER_S, GatewayError, SystemClock, failure_text
from igtl_gateway.addon.live import REPLAY_SETTINGS, Player, ReplayEvents, ReplayOptions, ReplaySides, run_replay
from igtl_gateway.addon.processes import ignore_endings, report_facts
from igtl_gateway.addon.reading import SessionFile
from igtl_gateway.addon.terminal import by_count, count_text
from igtl_gateway.addons.page.rhythm import Rhythm

_STATE_S = 0.2


def main() -> None:
    """The process."""
    ignore_endings()
    settings = json.loads(sys.stdin.readline() or "null")
    if settings:
        _Replay(settings).run()


class _Replay:
    def __init__(self, settings: dict[str, Any]) -> None:
        self._settings = settings
        self._stop = threading.Event()
        self._clock = SystemClock()
        self._player: Player | None = None
        self._file: SessionFile | None = None
        threading.Thread(target=self._listen, daemon=True).start()

    def run(self) -> None:
        given = {name: self._settings[name] for name in ("to", "side", "rate", "loop")}
        given |= {name: tuple(self._settings[name]) for name in ("listen", "connect") if self._settings[name]}
        given |= {"wait_peers": 0, "start_paused": True}
        events = ReplayEvents(on_line=self._say, controls=self._controls)
        try:
            how = ReplayOptions.of({row.name: row.default for row in REPLAY_SETTINGS} | given)
            result = run_replay(Path(self._settings["file"]), how, self._stop, events)
        except GatewayError as error:
            report_facts({"line": f"! {failure_text(error)}", "failed": True})
            return
        if result:
            nobody = f", and {found:,} while no peer was connected" if (found := result.without_peer) else ""
            sent = (
                f"{count_text(result.messages - result.without_peer, 'message')} "
                f"{by_count(result.messages - result.without_peer, 'was', 'were')} sent{nobody}"
            )
            report_facts({"line": sent, "ended": result.complete})

    def _say(self, text: str) -> None:
        """Report a line without the folder, which the page names already."""
        report_facts({"line": text.replace(f"{Path(self._settings['file']).parent}{os.sep}", "")})

    @contextmanager
    def _controls(self, file: SessionFile, player: Player, side: ReplaySides) -> Iterator[None]:
        self._file, self._player = file, player
        if self._settings["from_s"]:
            player.seek(file.start_ns + round(self._settings["from_s"] * NS_PER_S))
        if not self._settings["paused"]:
            player.resume()
        over = threading.Event()
        rhythms: dict[int, Rhythm] = {}

        def report() -> None:
            position_ns = player.position_ns
            state = {
                "position_s": 0.0 if position_ns is None else (position_ns - file.start_ns) / NS_PER_S,
                "duration_s": (file.end_ns - file.start_ns) / NS_PER_S,
                "paused": player.paused,
                "rate": player.rate,
                "sent": player.played.messages - player.played.without_peer,
                "without_peer": player.played.without_peer,
                "peers": _peers(side, rhythms, self._clock.monotonic_ns()),
            }
            report_facts({"state": state})

        def keep_reporting() -> None:
            report()
            while not over.wait(_STATE_S):
                report()
            report()  # what there was at the end

        reporter = threading.Thread(target=keep_reporting, daemon=True)
        reporter.start()
        try:
            yield
        finally:
            over.set()
            reporter.join()

    def _listen(self) -> None:
        for line in sys.stdin:
            self._obey(json.loads(line))
        self._stop.set()  # the page has ended

    def _obey(self, command: dict[str, Any]) -> None:
        player, file, value = self._player, self._file, command.get("value")
        if command["do"] == "stop":
            self._stop.set()
        if player is None or file is None:
            return
        actions: dict[str, Callable[[], object]] = {
            "play": player.resume,
            "pause": player.pause,
            "step": player.step,
            "rate": lambda: player.set_rate(float(value or 1)),
            "seek": lambda: player.seek(file.start_ns + round(float(value or 0) * NS_PER_S)),
        }
        if action := actions.get(command["do"]):
            action()


def _peers(side: ReplaySides, rhythms: dict[int, Rhythm], now_ns: int) -> list[dict[str, Any]]:
    """Return what the page shows of each listener."""
    found, traffic = [], side.traffic()
    for gone in rhythms.keys() - traffic.keys():
        del rhythms[gone]
    for link, (address, profile) in side.listeners.present().items() if side.listeners else ():
        counts = traffic.get(link)
        if counts is None:  # it has left meanwhile
            continue
        rhythm = rhythms.setdefault(link, Rhythm())
        rhythm.take(now_ns, counts.sent_messages)
        queue = {"queued": counts.queued_messages, "rate_hz": rhythm.rate_hz, "sent": counts.sent_messages}
        found.append({"peer": address, "profile": profile} | queue)
    return found


if __name__ == "__main__":
    main()
