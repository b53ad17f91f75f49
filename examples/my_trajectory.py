"""A trajectory of one's own: sample any function of time into a table, and fly the table.

python examples/my_trajectory.py spiral.csv
companion fly --sitl px4 --trajectory spiral.csv
"""

import math
import sys

import companion


def spiral(t: float) -> tuple[float, float, float, float]:
    """x, y, z in m and yaw in rad at time t in s: outwards and back within 20 s, nose along x."""
    radius = 0.4 * (1.0 - math.cos(math.tau * t / 20.0))
    return radius * math.cos(0.8 * t), radius * math.sin(0.8 * t), 1.0, 0.0


def write(path: str, duration_s: float = 20.0, rate_hz: float = 20.0) -> None:
    with open(path, "w", encoding="utf-8") as table:
        print("t,x,y,z,yaw", file=table)
        for k in range(round(duration_s * rate_hz) + 1):
            print(",".join(f"{value:.6f}" for value in (k / rate_hz, *spiral(k / rate_hz))), file=table)


if __name__ == "__main__":
    file = sys.argv[1]
    write(file)
    path = companion.trajectory(file)
    middle = path.sample(path.duration_s / 2)
    print(
        f"{file}: {path.duration_s:.0f} s; halfway at {middle.position_enu.round(2)} m, moving with", end=" "
    )
    print(f"{middle.velocity_enu.round(2)} m/s")
