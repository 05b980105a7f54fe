"""The session of a page: served to the programs that have its address, which has a token, and to no other one.

rerun's own server of streams has no access control: each user of the machine could read the session.  So rerun serves
its viewer only, which has no data, and the viewer fetches the session from here.  The token is in no command line,
since other users can read those.
"""

from __future__ import annotations

import os
from hmac import compare_digest
from pathlib import Path

from igtl_gateway.edges.tcp.http_server import Handler, LocalServer

#: A session of some GB, on a busy machine.
_DEADLINE_S = 600.0
_PIECE = 1 << 20
_NAME = "session.rrd"


class SessionServer:
    """Serves a rerun recording at an address with a token until closed.

    Attributes:
        base: the address without the token, at which nothing is served.
        url: the address of the recording.
    """

    def __init__(self, recording: Path, host: str) -> None:
        path = f"/{os.urandom(24).hex()}/{_NAME}"
        handler = type("_SessionHandler", (_Handler,), {"recording": recording, "secret": path.encode()})
        self._server = LocalServer(host, 0, handler, name="igtl-page", deadline_s=_DEADLINE_S)
        self.base = f"http://{self._server.address}/{_NAME}"
        self.url = f"http://{self._server.address}{path}"

    def close(self) -> None:
        """Stop serving."""
        self._server.close()


class _Handler(Handler):
    recording: Path
    secret: bytes

    def get(self, path: str) -> None:
        if not compare_digest(path.encode("utf-8", "surrogateescape"), self.secret):
            self.answer(403, "text/plain; charset=utf-8", "found another token, expected the printed address\n")
            return
        with self.recording.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            # the viewer's page has another port, which is another origin
            self.begin(200, "application/octet-stream", size, Access_Control_Allow_Origin="*", Cache_Control="no-store")
            while self.command != "HEAD" and (piece := stream.read(_PIECE)):
                self.wfile.write(piece)
