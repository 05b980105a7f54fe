"""The client or the server of openigtlink-ng in Python.

Arguments: folder of its schemas, ``client`` PORT or ``server``.  Lines of input are words to send; lines of output are
JSON: ``{"port"}``, ``{"connected"}``, ``{"sent"}`` with why it could not, or "", and of each message that it receives
``{"words", "data"}``, as its codec reads it and writes it again, or ``{"refused"}`` with its error.
"""

from __future__ import annotations

import asyncio
import json
import sys
from typing import Any

from ng_codec import made, schemas, shown
from oigtl import lookup_message_class, pack_envelope, registered_types
from oigtl.net import Client, Server


def report(**fields: Any) -> None:
    print(json.dumps(fields), flush=True)


async def main() -> None:
    fields = schemas(sys.argv[1])
    links: list[Any] = []

    async def take(envelope: Any, *_: Any) -> None:
        report(words=" ".join(shown(envelope, fields)), data=pack_envelope(envelope).hex())

    if sys.argv[2] == "server":
        here = await Server.listen(0, host="127.0.0.1")

        @here.on_connected
        async def _(peer: Any) -> None:
            links.append(peer)
            report(connected=True)
    else:
        here = await Client.connect("127.0.0.1", int(sys.argv[3]))
        links.append(here)

    @here.on_error
    async def _(error: BaseException) -> None:
        report(refused=str(error))

    for name in registered_types():
        here.on(lookup_message_class(name))(take)
    running = asyncio.ensure_future(here.serve() if sys.argv[2] == "server" else here.run())
    report(**({"port": here.port} if sys.argv[2] == "server" else {"connected": True}))
    while line := await asyncio.to_thread(sys.stdin.readline):
        try:
            body, device, ticks = made(line.split(), fields)
            await links[-1].send(body, device_name=device, timestamp=ticks)
        except ValueError as error:
            report(sent=str(error))
        else:
            report(sent="")
    running.cancel()


asyncio.run(main())
