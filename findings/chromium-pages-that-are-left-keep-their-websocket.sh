#!/bin/sh
# Chromium: a page that the user has left keeps its WebSocket open, answers pings, and loses what it is sent.
#
# Expected: the browser closes the connection with 1001 (going away) when the page is left.  Guess before the run: so, at once.
# Found: the page lies in the back/forward cache.  For seconds, if not minutes, the server sees an open connection whose pings are
#   answered; 50 messages are taken.  Who goes back finds the socket closed, and none of them.  A page that closes its socket at
#   "pagehide" is left in an orderly way.
# Versions: Chromium 156.0.8078.108 of the system, websockets 17.4, Python 3.11.
# Concerns: robots and viewers that take an open connection for a person who looks at it; counts of what a client has got.
set -eu
chromium=$(command -v chromium || command -v google-chrome) || { echo "found no Chromium"; exit 1; }
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check websockets==17.4 2> "$folder/pip.txt" || { cat "$folder/pip.txt"; exit 1; }
cat > "$folder/run.py" <<'PYTHON'
import http.server
import json
import os
import subprocess
import sys
import threading
import time

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve

chromium, folder = sys.argv[1:]
seen = {"sent": 0, "closed": None, "pong": False}
left = threading.Event()


def feed(page):
    left.wait()
    time.sleep(1)
    try:
        for _ in range(50):
            page.send(b"pose")
            seen["sent"] += 1
            time.sleep(0.02)
        seen["pong"] = page.ping().wait(5)
    except ConnectionClosed as end:
        seen["closed"] = str(end)
    time.sleep(60)


class Page(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<title>page</title>")

    def log_message(self, *_):
        pass


socket_server = serve(feed, "127.0.0.1", 0, compression=None)
threading.Thread(target=socket_server.serve_forever, daemon=True).start()
site = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Page)
threading.Thread(target=site.serve_forever, daemon=True).start()

to_read, write = os.pipe()
read, to_write = os.pipe()
options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", f"--user-data-dir={folder}/user"]
process = subprocess.Popen(
    ["bash", "-c", f'exec "$@" 3<&{to_read} 4>&{to_write}', "-", chromium, *options, "about:blank"],
    pass_fds=(to_read, to_write), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
)
rest, session, number = b"", "", 0


def call(method, **parameters):
    global rest, number
    number += 1
    words = {"id": number, "method": method, "params": parameters} | ({"sessionId": session} if session else {})
    os.write(write, json.dumps(words).encode() + b"\0")
    while True:
        while b"\0" not in rest:
            rest += os.read(read, 1 << 20)
        line, _, rest = rest.partition(b"\0")
        if (found := json.loads(line)).get("id") == number:
            return found["result"]


def run(program):
    return call("Runtime.evaluate", expression=program, returnByValue=True)["result"].get("value")


def until(program):
    end = time.monotonic() + 30
    while not run(program):
        assert time.monotonic() < end, program
        time.sleep(0.05)


print(call("Browser.getVersion")["product"])
target = next(each for each in call("Target.getTargets")["targetInfos"] if each["type"] == "page")
session = call("Target.attachToTarget", targetId=target["targetId"], flatten=True)["sessionId"]
call("Page.enable")
place = f"http://127.0.0.1:{site.server_port}/"
call("Page.navigate", url=place)
until("document.title === 'page'")
port = socket_server.socket.getsockname()[1]
run(f"window.got = 0; window.s = new WebSocket('ws://127.0.0.1:{port}'); s.onmessage = () => got++; 1")
until("s.readyState === 1")
call("Page.navigate", url="about:blank")
until("location.href === 'about:blank'")
left.set()
time.sleep(4)
history = call("Page.getNavigationHistory")
call("Page.navigateToHistoryEntry", entryId=history["entries"][history["currentIndex"] - 1]["id"])
until("document.title === 'page'")
time.sleep(1)
got, state = run("window.got"), run("window.s && s.readyState")
process.kill()
print(f"left: {seen['sent']} messages taken, ping answered: {seen['pong']}, closed: {seen['closed']}; back: {got} got, readyState {state}")
os._exit(not (seen["sent"] == 50 and seen["pong"] and got == 0 and state == 3))
PYTHON
"$folder/venv/bin/python" "$folder/run.py" "$chromium" "$folder"
