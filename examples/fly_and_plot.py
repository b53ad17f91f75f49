"""Fly the bundled stub from a script, print the errors, plot the path: python examples/fly_and_plot.py [SECONDS] [PNG]."""

import sys

import companion


def main(seconds: float = 20.0, picture: str = "flight.png") -> None:
    flown = companion.fly(sitl="px4", controller="dtlannc", trajectory="lemniscate", duration_s=seconds)
    print(f"{flown.outcome.value}: {flown.text}")
    metrics = companion.analyze(flown.log)
    print("RMS x, y, z against the truth [m]:", metrics.get("rms", "position_truth_m"))

    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    record = companion.read_log(flown.log)
    state, reference = record.channel("/state"), record.channel("/reference")
    assert state is not None and reference is not None
    figure, axes = plt.subplots()
    axes.plot(*reference["position_enu"][:, :2].T, "--", label="reference")
    axes.plot(*state["position_enu"][:, :2].T, label="estimate")
    axes.set(xlabel="east [m]", ylabel="north [m]", aspect="equal")
    axes.legend()
    figure.savefig(picture)
    print(picture)


if __name__ == "__main__":
    main(*(kind(word) for kind, word in zip((float, str), sys.argv[1:], strict=False)))
