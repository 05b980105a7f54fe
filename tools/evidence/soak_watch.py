"""Looks at a soak as it goes on: parts of the recording are verified, processes weighed."""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
import urllib.request
from pathlib import Path
from typing import Any

from igtl_gateway_lab.programs import ours
from tools.evidence.soak_findings import Found, Sample, Settings, say

_VERIFY_S = 3600.0
_MB = 1e6


class Verifier:
    """Verifies parts as they are completed, one after the other, and deletes those that are as they should be."""

    def __init__(self, folder: Path, settings: Settings, found: Found) -> None:
        self._folder, self._settings, self._found = folder, settings, found
        self._over = threading.Event()
        self._lock = threading.Lock()
        self._next = 0
        self._threads: list[threading.Thread] = []
        self._begin()

    def close(self) -> None:
        """The recording has ended: verify what is left, two at a time, as there is nothing else to do."""
        self._over.set()
        self._begin()
        for thread in self._threads:
            thread.join()

    def _begin(self) -> None:
        thread = threading.Thread(target=self._run, name="verifier")
        self._threads.append(thread)
        thread.start()

    def _run(self) -> None:
        while True:
            over = self._over.is_set()
            if path := self._due(over):
                self._verify(path)
            elif over:
                return
            else:
                self._over.wait(0.5)

    def _due(self, over: bool) -> Path | None:
        """The next part, if it is complete."""
        with self._lock:
            this, following = (self._folder / f"{self._folder.name}_{self._next + more}.mcap" for more in (0, 1))
            if not (following.exists() or (over and this.exists())):
                return None
            self._next += 1
            return this

    def _verify(self, path: Path) -> None:
        size = path.stat().st_size
        begun = time.monotonic()
        command = ["nice", "-n", "5", *ours("verify", str(path), "--json")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_VERIFY_S, check=False)
        part: dict[str, Any] = {
            "part": path.name,
            "bytes": size,
            "seconds": round(time.monotonic() - begun, 1),
            "code": done.returncode,
        }
        try:
            part |= {name: value for name, value in json.loads(done.stdout).items() if name not in ("file", "config")}
            part["differences"] = part["differences"][:20]
        except ValueError:
            part |= {"good": False, "error": done.stderr[-2000:]}
        self._found.parts.append(part)
        if not part["good"] or done.returncode:
            say(f"{path.name} DOES NOT VERIFY: {json.dumps(part)[:2000]}")
        elif not self._settings.keep:
            path.unlink()


def process(pid: int) -> Sample:
    """Memory in MB, threads, descriptors and CPU time of a process."""
    root = Path(f"/proc/{pid}")
    status = dict(line.split(":", 1) for line in (root / "status").read_text("ascii", "replace").splitlines())
    cpu = (root / "stat").read_text("ascii", "replace").rpartition(")")[2].split()
    return {
        **{
            word: round(float(status[name].split()[0]) * 1024 / _MB, 2)
            for word, name in (("rss_mb", "VmRSS"), ("anon_mb", "RssAnon"), ("shared_mb", "RssShmem"))
        },
        "threads": int(status["Threads"]),
        "fds": len(os.listdir(root / "fd")),
        "cpu_s": (int(cpu[11]) + int(cpu[12])) / os.sysconf("SC_CLK_TCK"),
    }


def children(pid: int) -> list[int]:
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            found += map(int, (task / "children").read_text("ascii").split())
        except OSError:
            continue  # a thread that has ended
    return found


def take(pid: int, url: str) -> Sample:
    """How the bridge is now; its recorder's process is the largest of its children."""
    with urllib.request.urlopen(url.removesuffix("/metrics") + "/status", timeout=30) as answer:
        facts = json.load(answer)
    others = [process(child) for child in children(pid)]
    queues = facts["queues"].values()
    recorder = facts["recorder"]
    return {
        "gateway": process(pid),
        "recorder": max(others, key=lambda one: one["rss_mb"]),
        "processes": 1 + len(others),
        "peers": sum(peer["connected"] for peer in facts["peers"]),
        "queued_messages": sum(queue["messages"] for queue in queues),
        "queued_mb": round(sum(queue["bytes"] for queue in queues) / _MB, 2),
        "recorder_queued_mb": round(recorder["queued_bytes"] / _MB, 2),
        "recorder_dropped": recorder["dropped_entries"],
        "entries": facts["entries"],
        "load": os.getloadavg()[0],
    }
