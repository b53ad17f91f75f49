"""References from another program, in ten lines: a circle of 1 m in 8 s, 50 points a second; after 60 s it is over.

companion fly --sitl px4 --real-time --trajectory live:udp:14700 --duration 60
python examples/stream_references.py 14700
"""

import json
import math
import socket
import sys
import time

port, seconds = int(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else 60.0
wire, start, w = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), time.monotonic(), math.tau / 8.0
while (t := time.monotonic() - start) < seconds:
    x, y = math.cos(w * t), math.sin(w * t)
    point = {"time": t, "position": [x, y, 1.0], "velocity": [-w * y, w * x, 0.0], "yaw": 0.0}
    wire.sendto(json.dumps(point).encode(), ("127.0.0.1", port))
    time.sleep(0.02)
wire.sendto(b'{"end": true}', ("127.0.0.1", port))
