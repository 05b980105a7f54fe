#!/bin/sh
# wsproto: a server loses a frame that comes in one segment with the request of the handshake, without an error.
#
# Expected: after AcceptConnection the frame is an event, as the client side has it for frames behind the response, or an error:
#   RFC 6455 lets a client wait for the answer.  Guess before the run: an event.
# Found: frame "A", which came with the request, is gone; frame "B", which came later, is the first.  As a client, wsproto keeps
#   what follows the response.  websockets 17.4 as a server gives both.
# Versions: wsproto 1.3.2, h11 0.16.0, websockets 17.4, Python 3.11.
# Concerns: clients in C that send their first message without waiting: a pose, or the one command, is missing in the recording.
#   Who serves with wsproto alone can look whether the received bytes end with the request.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check wsproto==1.3.2 h11==0.16.0 websockets==17.4 \
    2> "$folder/pip.txt" || { cat "$folder/pip.txt"; exit 1; }
cat > "$folder/run.py" <<'PYTHON'
import sys

from websockets.server import ServerProtocol
from wsproto import ConnectionType, WSConnection
from wsproto.events import AcceptConnection, BytesMessage, Request

A, B = (bytes([0x82, 0x81, 0, 0, 0, 0, letter]) for letter in b"AB")
request = WSConnection(ConnectionType.CLIENT).send(Request(host="a", target="/"))

server, got = WSConnection(ConnectionType.SERVER), []
server.receive_data(request + A)
for event in server.events():
    server.send(AcceptConnection())
for part in (b"", B):
    if part:
        server.receive_data(part)
    got += [event.data for event in server.events() if isinstance(event, BytesMessage)]

other = ServerProtocol()
other.receive_data(request + A)
asked, *events = other.events_received()
other.send_response(other.accept(asked))
other.receive_data(B)
others = [event.data for event in [*events, *other.events_received()]]
print(f"wsproto: {got}; websockets: {others}")
sys.exit((got, others) != ([b"B"], [b"A", b"B"]))
PYTHON
"$folder/venv/bin/python" "$folder/run.py"
