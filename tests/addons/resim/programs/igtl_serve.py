"""A pyigtl server: answers each TRANSFORM, and sends a STRING with its clock every 100 ms."""

import sys
import time

import pyigtl

server = pyigtl.OpenIGTLinkServer(port=int(sys.argv[1]), local_server=True)
begin, sent = time.monotonic(), 0
while True:
    for message in server.get_latest_messages():
        matrix = message.matrix.copy()
        matrix[1, 3] -= 2.0
        server.send_message(pyigtl.TransformMessage(matrix, device_name="Answer"), wait=False)
    if server.is_connected() and time.monotonic() - begin >= 0.1 * (sent + 1):
        sent += 1
        text = f"{time.monotonic() - begin:.3f}"
        server.send_message(pyigtl.StringMessage(text, device_name="Clock"), wait=False)
    time.sleep(0.005)
