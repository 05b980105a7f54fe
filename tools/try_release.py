"""Install the files of a release by docs/start/install.md, and time it from an empty folder to the first message.

    python3.12 tools/try_release.py dist [--pure] [--extras ros,view] [--wheelhouse FOLDER]

It uses the Python that runs it, and only the standard library.  The programs are those of the page, with a free port;
the distributions of others come from the package index of pip, or from ``--wheelhouse``.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "start" / "install.md"
PORT = "18944"
#: For pip on a slow network, and for a message on a busy machine.
LONGEST_STEP_S, LONGEST_WAIT_S = 900, 100
#: Length of a recording without ROS.
RECORDED_S = 2.0
#: Architectures with ROS wheels; elsewhere the release is tried without ROS.
ROS_MACHINES = ("x86_64",)
#: A ROS domain that no robot uses by default.
ENVIRONMENT = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "97"}


def programs(page: str) -> dict[str, str]:
    """File name → the program that the page lists for it: a block of Python whose first line is the name."""
    return {
        name: text for name, text in re.findall(r"^```python\n# (\w+\.py)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    }


class Trial:
    """A fresh environment in a folder, and the seconds of each step."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = {**os.environ, **ENVIRONMENT, "PYTHONPATH": "", "XDG_CACHE_HOME": str(folder / "cache")}
        self.start = time.monotonic()

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Print the seconds of a step."""
        begin = time.monotonic()
        yield
        print(f"{time.monotonic() - begin:8.1f} s  {name}", flush=True)

    def run(self, *words: str) -> str:
        """Run a program of the environment, and return what it prints.  Ends this program if it fails."""
        done = subprocess.run(
            [str(self.folder / "igtl" / "bin" / words[0]), *words[1:]],
            cwd=self.folder,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=LONGEST_STEP_S,
            check=False,
        )
        if done.returncode:
            sys.exit(f"{' '.join(words)}: exit code {done.returncode}\n{done.stdout}")
        return done.stdout

    @contextmanager
    def running(self, *words: str) -> Iterator[subprocess.Popen[str]]:
        """Run a program beside the next steps, and end it with Ctrl-C."""
        command = [str(self.folder / "igtl" / "bin" / words[0]), *words[1:]]
        with subprocess.Popen(
            command, cwd=self.folder, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as process:
            try:
                yield process
            finally:
                process.send_signal(signal.SIGINT)


def free_port() -> int:
    """Return a port of this machine that no program uses."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def install(trial: Trial, requirement: list[str]) -> str:
    """Make the environment, install ``requirement`` (words of pip), and return what ``--version`` prints."""
    with trial.step("python3 -m venv igtl"):
        subprocess.run([sys.executable, "-m", "venv", "igtl"], cwd=trial.folder, check=True)
    with trial.step("pip install"):
        trial.run("pip", "install", "--quiet", "--disable-pip-version-check", *requirement)
    with trial.step("igtl-gateway --version"):
        return trial.run("igtl-gateway", "--version")


def exchange(trial: Trial) -> str:
    """Pass a message from a peer to a ROS node, verify the recording, and return what the programs printed."""
    port = str(free_port())
    for name, text in programs(PAGE.read_text("utf-8")).items():
        (trial.folder / name).write_text(text.replace(PORT, port), "utf-8")
    command = ["igtl-gateway", "bridge", "--listen", f":{port}", "--record", "out.mcap"]
    with (
        trial.step("bridge: first message"),
        trial.running(*command) as bridge,
        trial.running("python", "listen.py") as node,
    ):
        while bridge.poll() is None and not listens(int(port)):
            time.sleep(0.02)
        with trial.running("python", "send.py"):
            try:
                heard = node.communicate(timeout=LONGEST_WAIT_S)[0]
            except subprocess.TimeoutExpired:
                bridge.send_signal(signal.SIGINT)
                sys.exit(f"no message arrived in {LONGEST_WAIT_S} s\n{bridge.communicate()[0]}")
    with trial.step("igtl-gateway verify out.mcap"):
        return heard + trial.run("igtl-gateway", "verify", "out.mcap")


def record(trial: Trial) -> str:
    """Record messages of a peer without ROS, verify the recording, and return what the programs printed."""
    port = str(free_port())
    (trial.folder / "send.py").write_text(programs(PAGE.read_text("utf-8"))["send.py"].replace(PORT, port), "utf-8")
    command = ["igtl-gateway", "bridge", "--no-ros", "--listen", f":{port}", "--record", "out.mcap"]
    with trial.step("bridge: first messages"), trial.running(*command) as bridge:
        while bridge.poll() is None and not listens(int(port)):
            time.sleep(0.02)
        with trial.running("python", "send.py"):
            time.sleep(RECORDED_S)
    with trial.step("igtl-gateway verify out.mcap"):
        return trial.run("igtl-gateway", "info", "out.mcap") + trial.run("igtl-gateway", "verify", "out.mcap")


def listens(port: int) -> bool:
    """Whether a program listens on the port."""
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


def main() -> None:
    """Try the release in a temporary folder."""
    parser = argparse.ArgumentParser(description="Install a release, and time it to the first message.")
    parser.add_argument("dist", type=Path, help="the folder with the files of the release")
    parser.add_argument("--extras", default="ros,view", help="extras to install (default: ros,view)")
    parser.add_argument("--pure", action="store_true", help="install the wheel without C parts")
    parser.add_argument("--wheelhouse", type=Path, help="use only the distributions in this folder, and no network")
    options = parser.parse_args()
    ours = options.dist.resolve()
    (pure,) = ours.glob("igtl_gateway-*-none-any.whl")
    version = pure.name.split("-")[1]
    words = ["--find-links", str(ours)]
    if options.wheelhouse:
        words += ["--no-index", "--find-links", str(options.wheelhouse.resolve())]
    if options.pure:
        words += [f"igtl-gateway[{options.extras}] @ {pure.as_uri()}"]
    else:
        words += [f"igtl-gateway[{options.extras}]=={version}"]
    has_ros = "ros" in options.extras.split(",") and platform.machine() in ROS_MACHINES
    with tempfile.TemporaryDirectory() as folder:
        trial = Trial(Path(folder))
        versions = install(trial, words)
        printed = exchange(trial) if has_ros else record(trial)
        print(f"{time.monotonic() - trial.start:8.1f} s  in total\n\n{printed}\n{versions}")


if __name__ == "__main__":
    main()
