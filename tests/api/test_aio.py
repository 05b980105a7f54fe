"""Peers with asyncio."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

import numpy as np
import pytest

from igtl_gateway import aio
from igtl_gateway.api.received import ReceivedMessage
from igtl_gateway.base.errors import LinkClosed, NoReply, Refused

T = TypeVar("T")


def run(main: Coroutine[Any, Any, T]) -> T:
    return asyncio.run(asyncio.wait_for(main, 20))


def test_messages_in_both_directions() -> None:
    async def main() -> list[str]:
        async with aio.serve(0) as server, aio.connect(port=server.port) as peer:
            await server.wait_connected()
            await peer.send("TRANSFORM", "Tool", np.eye(4))
            message = await server.receive("TRANSFORM")
            assert message.matrix.tolist() == np.eye(4).tolist()

            async def count() -> None:
                for number in range(100):
                    await server.send("STRING", "Count", str(number))
                server.disconnect(message.link)

            counting = asyncio.create_task(count())
            found = [message.text async for message in peer]
            await counting
            with pytest.raises(LinkClosed):
                await peer.send("STRING", "a", "b")
            return found

    assert run(main()) == [str(number) for number in range(100)]


def test_queries_and_commands_with_coroutines() -> None:
    async def main() -> None:
        async with aio.serve(0) as server, aio.connect(port=server.port) as peer:

            @server.on_command("Slow")
            async def slow(command: ReceivedMessage) -> str:
                await asyncio.sleep(0.01)
                return command.text.upper()

            @server.on_query("TRANSFORM")
            def pose(query: ReceivedMessage) -> object:
                return np.eye(4) if query.device else None

            @server.on_query("TDATA", "STT")
            async def start(query: ReceivedMessage) -> bool:
                return True

            assert (await peer.command("Slow", "text")).text == "TEXT"
            assert (await peer.query("TRANSFORM", "Tool")).matrix.tolist() == np.eye(4).tolist()
            with pytest.raises(Refused):
                await peer.query("TRANSFORM")
            await peer.start_stream("TDATA")
            await peer.start_stream("POLYDATA", timeout_s=0)
            with pytest.raises(NoReply):
                await peer.stop_stream("TDATA", timeout_s=0.01)
            assert peer.counts.received >= 4
            assert peer.is_connected
            assert await peer.flush()

    run(main())


def test_a_cancelled_receive_takes_no_message() -> None:
    async def main() -> None:
        async with aio.serve(0) as server, aio.connect(port=server.port) as peer:
            waiting = [asyncio.create_task(server.receive()) for _ in range(20)]
            await asyncio.sleep(0.01)
            for task in waiting:
                task.cancel()
            await asyncio.gather(*waiting, return_exceptions=True)
            await peer.send("STRING", "a", "kept")
            assert (await server.receive()).text == "kept"
            with pytest.raises(NoReply):
                await server.receive(timeout_s=0.01)
            assert not server._talk.wakers

    run(main())


def test_a_slow_reader_does_not_stop_the_loop() -> None:
    async def main() -> None:
        turns = 0

        async def turn() -> None:
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0.001)

        turning = asyncio.create_task(turn())
        streams: list[object] = []  # the garbage collector would close the connection
        listener = await asyncio.start_server(lambda *pair: streams.append(pair), "127.0.0.1", 0, limit=1024)
        async with listener:
            port = listener.sockets[0].getsockname()[1]
            peer = await aio.connect(port=port)
            picture = np.zeros((2000, 2000), np.uint8)
            sending = asyncio.create_task(_send_all(peer, picture))
            await asyncio.sleep(0.3)
            assert not sending.done()  # the send queue is full
            before = turns
            while turns < before + 10:
                await asyncio.sleep(0.001)
            assert not sending.done()
            await peer.close()
            await asyncio.gather(sending, return_exceptions=True)
        turning.cancel()

    run(main())


async def _send_all(peer: aio.AsyncPeer, picture: Any) -> None:
    for _ in range(200):
        await peer.send("IMAGE", "Camera", picture)


def test_without_a_server() -> None:
    async def main() -> None:
        async with aio.serve(0) as server:
            port = server.port
        with pytest.raises(NoReply, match="expected an OpenIGTLink server"):
            await aio.connect(port=port, timeout_s=0.05)

    run(main())
