"""The viewer as a child process: a window, or a page for a browser; on loopback only, stopped with this process."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping, Sequence
from hmac import compare_digest
from pathlib import Path
from urllib.parse import quote

from igtl_gateway.addon import Self, ViewerError
from igtl_gateway.addon.live import Handler, LocalServer
from igtl_gateway.addons.view.process import ViewerProcess

HOST = "127.0.0.1"
_LISTENS = re.compile(r"Listening for gRPC connections on 127\.0\.0\.1:([0-9]+)")
_HOSTS = re.compile(r"Hosting a web-viewer at http://127\.0\.0\.1:([0-9]+)")
_LOG = "error,re_grpc_server=info,re_sdk::web_viewer=info"
_START_S = 30.0
_LIVE_MEMORY = "25%"  # of the machine: in a long session the window drops the oldest data


#: A session of some GB, on a busy machine.
_DEADLINE_S = 600.0
_PIECE = 1 << 20
_NAME = "session.rrd"


class SessionServer:
    """Serves rerun recordings at addresses with a token until closed.

    rerun's own server of streams has no access control: each user of the machine could read the session.  So rerun
    serves its viewer only, which has no data, and the viewer fetches the session from here.  The token is in no command
    line, since other users can read those.

    Attributes:
        base: the address without the token, at which nothing is served.
        urls: the addresses of the recordings.
    """

    def __init__(self, recordings: Sequence[Path], host: str) -> None:
        secrets = {f"/{os.urandom(24).hex()}/{_NAME}": recording for recording in recordings}
        handler = type("_SessionHandler", (_Handler,), {"recordings": secrets})
        self._server = LocalServer(host, 0, handler, name="igtl-page", deadline_s=_DEADLINE_S)
        self.base = f"http://{self._server.address}/{_NAME}"
        self.urls = [f"http://{self._server.address}{path}" for path in secrets]

    def close(self) -> None:
        """Stop serving."""
        self._server.close()


class _Handler(Handler):
    recordings: Mapping[str, Path]  # by their paths with a token

    def get(self, path: str) -> None:
        asked = path.encode("utf-8", "surrogateescape")
        recording = next(
            (one for secret, one in self.recordings.items() if compare_digest(asked, secret.encode())), None
        )
        if recording is None:
            self.answer(403, "text/plain; charset=utf-8", "found another token, expected the printed address\n")
            return
        with recording.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            # the viewer's page has another port, which is another origin
            self.begin(200, "application/octet-stream", size, Access_Control_Allow_Origin="*", Cache_Control="no-store")
            while self.command != "HEAD" and (piece := stream.read(_PIECE)):
                self.wfile.write(piece)


class Viewer:
    """A running viewer; a context manager.

    Attributes:
        url: address for recording streams (for a page, the address for a browser).
    """

    def __init__(self, arguments: Sequence[str], expected: Sequence[re.Pattern[str]]) -> None:
        self.url = ""
        self._session: SessionServer | None = None
        self._process = ViewerProcess(arguments, _LOG, expected)
        self._found = self._process.found
        if not self._process.ready.wait(_START_S) or not all(self._found):
            self.close()
            raise ViewerError(f"the viewer did not start; its last log lines: {self._process.last_lines()}")

    @classmethod
    def window(cls, recordings: Sequence[Path] = ()) -> Self:
        """Open a window, with recordings or for a stream.  Raises ViewerError, also without a screen."""
        check_screen(os.environ)
        what = [*map(str, recordings)] if recordings else ["--expect-data-soon", "--memory-limit", _LIVE_MEMORY]
        viewer = cls([*what, "--bind", HOST, "--port", "auto", "--hide-welcome-screen"], [_LISTENS])
        viewer.url = f"rerun+http://{HOST}:{viewer._found[0]}/proxy"
        return viewer

    @classmethod
    def page(cls, recordings: Sequence[Path], port: int = 0) -> Self:
        """Serve a page at ``port`` (0: any free port) for browsers on this machine.  Raises ViewerError.

        The sessions are served only to who has the ``url``, see ``SessionServer``.
        """
        session = SessionServer(recordings, HOST)
        # with an address to show, rerun starts no server of streams; this one has no token, as others can read it
        arguments = [session.base, "--serve-web", "--bind", HOST, "--port", "auto", "--web-viewer-port", str(port)]
        try:
            viewer = cls(arguments, [_HOSTS])
        except BaseException:
            session.close()
            raise
        viewer._session = session
        shown = "&".join(f"url={quote(url, safe='')}" for url in session.urls)
        viewer.url = f"http://{HOST}:{viewer._found[0]}/?{shown}"
        return viewer

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def ended(self) -> bool:
        """Whether the viewer has exited; cheap to read."""
        return self._process.ended.is_set()

    def close(self) -> None:
        """Stop the viewer; a second call does nothing."""
        self._process.close()
        if self._session:
            self._session.close()
            self._session = None


def check_screen(environment: Mapping[str, str]) -> None:
    """Raise ViewerError if no window can be shown."""
    if sys.platform == "linux" and not any(environment.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        raise ViewerError(
            "found no screen (neither DISPLAY nor WAYLAND_DISPLAY is set), expected a screen for the window; "
            "without a screen use `igtl-gateway view` with -o FILE or --web"
        )
