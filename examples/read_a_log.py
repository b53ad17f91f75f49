"""What happened in a flight: phases, what the supervisor did, errors, and whether every step repeats.

python examples/read_a_log.py flights/flight.mcap
"""

import sys

import companion


def main(path: str) -> None:
    record = companion.read_log(path)
    print(
        f"{record.flight.get('controller')} at level {record.flight.get('level')}, {record.flight.get('firmware')}"
    )
    for event in record.events:
        if event.kind in ("phase", "safety", "ended"):
            words = ", ".join(f"{key} {value}" for key, value in event.fields.items())
            print(f"{event.time_s:8.2f} s  {event.kind}: {words}")
    metrics = companion.analyze(record)
    for name in ("position_truth_m", "position_estimate_m"):
        print(f"RMS {name}: {metrics.get('rms', name)}")
    repeated = companion.replay(record)
    print(f"{repeated.identical} of {repeated.steps} control steps repeat bit for bit")


if __name__ == "__main__":
    main(sys.argv[1])
