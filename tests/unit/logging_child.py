"""A process that logs until it is killed. It says on stdout when what was logged: 8 bytes a record.

python logging_child.py FILE paced|busy|slow-sync|limited
"""

import os
import struct
import sys
import time

import numpy as np

from companion.flightlog import writer
from companion.flightlog.channels import STATE, weights_channel

path, option = sys.argv[1:]
if option == "slow-sync":
    os.fdatasync = lambda descriptor: time.sleep(0.5)
log = writer.FlightLog(path, {"seed": "1"}, channels=[STATE], overwrite=True)
state, weights = log.define(STATE), log.define(weights_channel("position", 20))
rng = np.random.default_rng(0)
if option == "limited":
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY))
    slowest = 0.0
    for i in range(4000):
        numbers = rng.normal(size=14)
        start = time.perf_counter()
        log.record(state, 0.004 * i, numbers)
        slowest = max(slowest, time.perf_counter() - start)
        if i % 100 == 0:
            time.sleep(0.02)
    health = log.close()
    assert "too large" in health.trouble, health
    os.write(1, struct.pack("<3d", 1000 * slowest, health.lost, health.written))
    sys.exit(0)
os.write(1, bytes(8))
start = time.monotonic()
while True:
    now = time.monotonic() - start
    numbers = np.zeros(14)
    numbers[0] = now
    log.record(state, now, numbers)
    log.record(weights, now, rng.normal(size=(20, 3)))
    for _ in range(4):
        log.mavlink("in", now, b"\xfd" * 40)
    os.write(1, struct.pack("<d", now))
    if option == "busy":
        busy_until = now + 0.004
        while time.monotonic() - start < busy_until:
            pass
    else:
        time.sleep(0.004)
