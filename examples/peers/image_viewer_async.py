"""Receive images with asyncio and print their size, place and mean, while another task counts all messages.

python image_viewer_async.py [--host 127.0.0.1] [--port 18944] [--count 0]
"""

import argparse
import asyncio

from igtl_gateway import aio

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--host", default="127.0.0.1")
parser.add_argument("--port", type=int, default=18944)
parser.add_argument("--count", type=int, default=0, help="end after this number of images; 0: never")
options = parser.parse_args()


async def main() -> None:
    async with aio.connect(options.host, options.port) as peer:

        async def count() -> None:
            while True:
                await asyncio.sleep(1.0)
                print(f"{peer.counts.received:,} messages", flush=True)

        counting = asyncio.create_task(count())
        number = 0
        async for message in peer:
            if message.type == "IMAGE":
                number += 1
                origin = (message.matrix[:3, 3].round(3) + 0.0).tolist()  # without -0.0
                print(message.device, message.array.shape, origin, f"{message.array.mean():.1f}", flush=True)
            if number == options.count > 0:
                break
        counting.cancel()


asyncio.run(main())
