"""Whether gains stand a response that is slower, and a loop that is stiffer, than was found: flown on the lagged plant."""

from __future__ import annotations

from companion.config.common_gains import common_gains
from companion.config.gains import ControllerGains
from companion.config.profile import VehicleProfile
from companion.config.settings import DEFAULT_RATE_HZ
from companion.control.structs import ControlLevel
from companion.tuning.flight import PlantChoice, Scenario, TrialFlight
from companion.tuning.reference_table import reference_table

FACTOR = 1.5
LAG_MARGINS = (1.0, 1.05, 1.1, 1.2, 1.35, 1.5, 1.75, 2.0)
"""What is tried, the quickest first."""
SWINGS = 3.0
"""Body rate beyond the reference's own, as a multiple of the calm flight's, from which on it counts as swinging up."""
_STIFFER = ("K_U", "K_i", "N", "alpha")


def stiffened(gains: ControllerGains, factor: float) -> ControllerGains:
    """The gains whose feedback force is `factor` times as large."""
    loop = gains.position_loop
    update = {name: getattr(loop, name) for name in _STIFFER}
    update = {
        name: tuple(factor * one for one in value) if isinstance(value, tuple) else factor * value
        for name, value in update.items()
    }
    return gains.model_copy(update={"position_loop": loop.model_copy(update=update)})


def least_lag_margin(profile: VehicleProfile, autopilot: str, controller: str = "dtlannc") -> float | None:
    """The least of `LAG_MARGINS` whose gains fly with `FACTOR` times the gain, and with that much more lag and dead time.

    At the attitude level. None where not even the last does.
    """
    dead_s = profile.response(autopilot).dead_time(ControlLevel.ATTITUDE)
    table = reference_table("lemniscate", DEFAULT_RATE_HZ["attitude"], dead_s, 14.0)
    plant = PlantChoice("lagged", "mocap")
    late = Scenario("late", lag_factor=FACTOR, delay_s=(FACTOR - 1.0) * dead_s)
    calm, slow = (
        TrialFlight(profile, autopilot, controller, "attitude", scenario, table, plant)
        for scenario in (Scenario(), late)
    )
    for margin in LAG_MARGINS:
        slower = profile.model_copy(update={"lag_margin": margin})
        gains = ControllerGains.model_validate(common_gains(slower, controller, "attitude", autopilot))
        usual = calm.fly(gains)
        shaken = [calm.fly(stiffened(gains, FACTOR)), slow.fly(gains)]
        quiet = float(max(usual.shake_rms_rad_s))
        if usual.flown == 1.0 and all(
            one.flown == 1.0 and float(max(one.shake_rms_rad_s)) < SWINGS * quiet for one in shaken
        ):
            return margin
    return None
