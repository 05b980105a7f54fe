"""The page as a server: what a browser may read and do.

Two tokens give access, one to see and do, one to see only.  The link with a token sets a cookie that scripts cannot
read and that no other site's requests carry.  What changes something needs the first token, the page's own origin and
JSON as its type, which no form of a foreign site can send.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from hmac import compare_digest
from http.cookies import CookieError, SimpleCookie
from importlib.resources import files
from typing import Any, Protocol
from urllib.parse import parse_qs, urlsplit

from igtl_gateway.addon import WireError
from igtl_gateway.addon.live import Handler, LocalServer, TlsFiles
from igtl_gateway.addon.untrusted import whole_number
from igtl_gateway.addons.page.pictures import small_png

#: Longest time of a request: a snapshot of half a gigabyte on a slow disk.
_DEADLINE_S = 90.0
_STATIC = {
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
#: What the browser may load and do: this page's own files, no frames, nothing of other sites.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
TEXT, JSON = "text/plain; charset=utf-8", "application/json"


class Shown(Protocol):
    """What the server shows; see ``process.Page``."""

    def state(self) -> tuple[int, bytes]: ...
    def sessions(self) -> list[dict[str, Any]]: ...
    def places(self, name: str) -> dict[str, Any] | None: ...
    def plot(self, name: str, key: str, field: str) -> dict[str, Any] | None: ...
    def curve(self, side: str, stream: str, field: str) -> dict[str, Any] | None: ...
    def lines(self, job: int) -> list[str]: ...
    def picture(self, side: str, stream: str) -> bytes: ...
    def act(self, what: str, words: dict[str, Any]) -> tuple[bool, str]: ...


class PageServer:
    """Serves a page until closed.

    Attributes:
        link: for a person, with the token.
        spectators: for those who see only.

    Args:
        host, port: address to listen on; port 0 chooses a free port.
        page: what is shown.
        allow: networks (CIDR) whose browsers may connect in addition to those of this host.
        tls: certificate and key; None: without TLS.

    Raises ConfigError and Unavailable as ``TcpEdge.listen`` does.
    """

    def __init__(
        self, host: str, port: int, page: Shown, allow: Sequence[str] = (), tls: TlsFiles | None = None
    ) -> None:
        tokens = os.urandom(24).hex(), os.urandom(24).hex()
        secure = tls is not None
        handler = type("_PageHandler", (_Handler,), {"page": page, "tokens": tokens, "secure": secure})
        self._server = LocalServer(
            host,
            port,
            handler,
            name="igtl-page",
            allow=allow,
            deadline_s=_DEADLINE_S,
            tls=tls.server() if tls else None,
        )
        base = f"{'https' if secure else 'http'}://{self._server.reachable}/?token="
        self.link, self.spectators = base + tokens[0], base + tokens[1]

    def close(self) -> None:
        """Stop serving."""
        self._server.close()


class _Handler(Handler):
    page: Shown
    tokens: tuple[str, str]
    secure: bool

    def get(self, path: str) -> None:
        words = {name: found[0] for name, found in parse_qs(urlsplit(self.path).query).items()}
        if path == "/" and "token" in words:
            self._open(words["token"])
        elif (role := self._role()) is None:
            self._say(403, "found no access, expected the link that the program printed\n")
        elif path == "/":
            self._send("text/html; charset=utf-8", _file("index.html"))
        elif path in _STATIC:
            name, kind = _STATIC[path]
            self._send(kind, _file(name))
        elif path == "/api/state":
            version, state = self.page.state()
            is_known = words.get("known") == str(version)
            self._send(JSON, b"" if is_known else state, Page_Version=str(version), Page_Role=role)
        elif path == "/api/sessions":
            self._json(self.page.sessions())
        elif path == "/api/places":
            self._json(self.page.places(words.get("name", "")))
        elif path == "/api/plot":
            self._json(self.page.plot(*(words.get(name, "") for name in ("name", "stream", "field"))))
        elif path == "/api/curve":
            self._json(self.page.curve(*(words.get(name, "") for name in ("side", "stream", "field"))))
        elif path == "/api/job" and (number := whole_number(words.get("number"))) is not None:
            self._json(self.page.lines(number))
        elif path == "/api/picture":
            self._picture(words.get("side", ""), words.get("stream", ""))
        else:
            self._say(404, "not found\n")

    def post(self, path: str, body: bytes) -> None:
        scheme = "https" if self.secure else "http"
        hosts, origins = self.headers.get_all("Host") or [], self.headers.get_all("Origin") or []
        role = self._role()
        if role is None:
            self._say(403, "found no access, expected the link that the program printed\n")
        elif len(hosts) != 1 or origins != [f"{scheme}://{hosts[0]}"]:
            self._say(403, "Origin: found another one, expected that of this page\n")
        elif self.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
            self._say(403, "Sec-Fetch-Site: found another site, expected this page\n")
        elif self.headers.get_content_type() != JSON:
            self._say(415, f"Content-Type: found another one, expected {JSON}\n")
        elif role != "full":
            self._json({"done": False, "text": "this link is read-only"}, 403)
        else:
            self._act(path, body)

    def _act(self, path: str, body: bytes) -> None:
        try:
            words = json.loads(body)
        except (ValueError, RecursionError):
            words = None
        if path != "/api/act" or not isinstance(words, dict) or not isinstance(words.get("do"), str):
            self._say(400, 'found another request, expected {"do": …} at /api/act\n')
            return
        done, text = self.page.act(words["do"], words)
        self._json({"done": done, "text": text})

    def _open(self, token: str) -> None:
        """Answer the printed link: the page, and the cookie with which it asks for the rest."""
        if not any(self._same(token, known) for known in self.tokens):
            self._say(403, "found another token, expected the printed link; each start of the program has its own\n")
            return
        secure = "; Secure" if self.secure else ""
        cookie = f"{self._cookie}={token}; Path=/; HttpOnly; SameSite=Strict{secure}"
        self._send("text/html; charset=utf-8", _file("index.html"), Set_Cookie=cookie)

    def _role(self) -> str | None:
        """Return ``full`` or ``spectator`` by the cookie of a request; None for one without access."""
        try:
            found = SimpleCookie("; ".join(self.headers.get_all("Cookie") or [])).get(self._cookie)
        except CookieError:
            return None
        given = found.value if found else ""
        full, spectator = self.tokens
        return "full" if self._same(given, full) else "spectator" if self._same(given, spectator) else None

    @property
    def _cookie(self) -> str:
        """Its name: browsers send cookies to all ports of a host."""
        return f"igtl_page_{self.server.server_address[1]}"

    def _picture(self, side: str, stream: str) -> None:
        try:
            data = small_png(found) if (found := self.page.picture(side, stream)) else b""
        except WireError:
            data = b""
        if data:
            self._send("image/png", data)
        else:
            self._say(404, "no picture\n")

    def _json(self, found: object, code: int = 200) -> None:
        self._send(JSON, json.dumps(found).encode(), code)

    def _say(self, code: int, text: str) -> None:
        self._send(TEXT, text.encode(), code)

    def _send(self, kind: str, data: bytes, code: int = 200, **more: str) -> None:
        headers = {name.replace("-", "_"): value for name, value in _HEADERS.items()}
        self.begin(code, kind, len(data), **headers, **more)
        if self.command != "HEAD":
            self.wfile.write(data)

    @staticmethod
    def _same(given: str, known: str) -> bool:
        return compare_digest(given.encode("utf-8", "surrogatepass"), known.encode())


def _file(name: str) -> bytes:
    return files(__package__).joinpath("static").joinpath(name).read_bytes()
