"""A peer on pygtlink that sends what standard input has and prints what it receives: see foreign_peers.py."""

import sys
import threading
from urllib.parse import quote, unquote

import numpy as np
from pygtlink import (  # type: ignore[import-not-found]
    ClientSocket,
    ImageMessage2,
    MessageBase,
    PositionMessage,
    SensorMessage,
    SocketServer,
    StatusMessage,
)

CLASSES = {"IMAGE": ImageMessage2, "POSITION": PositionMessage, "STATUS": StatusMessage, "SENSOR": SensorMessage}


def made(kind, words):
    message = CLASSES[kind]()
    if kind == "POSITION":
        message.setPosition([*map(float, words[:3])])
        message.setQuaternion([*map(float, words[3:])])
    elif kind == "STATUS":
        message.setCode(int(words[0]))
        message.setSubCode(int(words[1]))
        message.setErrorName(unquote(words[2][1:]))
    elif kind == "SENSOR":
        values = np.array(words[1:], float)
        message.setLength(len(values))
        message.setData(values)
    else:
        columns, rows, _, scalar, parts = map(int, words[:5])
        pixels = np.frombuffer(bytes.fromhex(words[-1][1:]), np.uint8)
        message.setScalarType(scalar)
        message.setNumComponents(parts)
        message.setSpacing([1, 1, 1])
        message.setData(pixels.reshape((rows, columns, *((parts,) if parts > 1 else ()))))
    return message


def content(message):
    if isinstance(message, PositionMessage):
        return [*message.getPosition(), *message.getQuaternion()]
    if isinstance(message, StatusMessage):
        return [message.getCode(), message.getSubCode(), "=" + quote(message.getErrorName()), "="]
    if isinstance(message, SensorMessage):
        return [*message.getData()]
    size, matrix = message.getDimensions(), np.asarray(message.getMatrix())
    spacing = np.asarray(message.getSpacing())
    place = np.concatenate([(matrix[:3, :3] * spacing).T.ravel(), matrix[:3, 3]])
    return [
        *size,
        int(message.getScalarType()),
        message.getNumComponents(),
        2,
        1,
        *place,
        "=" + message.getData().tobytes().hex(),
    ]


def receive(link):
    while head := link.receive(58):
        base = MessageBase()
        base.header = head
        base.unpack()
        kind = base.getMessageType()
        body = link.receive(base.getBodySizeToRead()) if base.getBodySizeToRead() else b""
        words = [kind, "=" + quote(base.getDeviceName()), *base.getTimeStampSecFrac(), base.getHeaderVersion()]
        try:
            message = CLASSES[kind]()
            message.copyHeader(base)
            message.body = body
            message.unpack()
            words += content(message)
        except Exception as error:  # what it cannot read is a result
            words = ["error", f"={kind}:{type(error).__name__}:{error}".replace(" ", "%20")]
        print(*words, flush=True)


if sys.argv[1] == "client":
    link = ClientSocket()
    link.connectToServer(sys.argv[2], int(sys.argv[3]))
else:
    link = SocketServer()
    link.setAddress("127.0.0.1", int(sys.argv[2]))
    link.start()
    print("ready", flush=True)
    link.waitForConnection()
print("ready", flush=True)
threading.Thread(target=receive, args=(link,), daemon=True).start()
for line in sys.stdin:
    kind, device, stamp_ns, *words = line.split()
    try:
        message = made(kind, words)
        message.setDeviceName(unquote(device[1:]))
        message.setTimeStamp(int(stamp_ns) / 1e9)
        message.pack()
        link.send(message.header + message.body)
    except Exception as error:
        print("error", f"={kind}:{type(error).__name__}:{error}".replace(" ", "%20"), flush=True)
