"""Laws, states and references for the tests of whole steps."""

from __future__ import annotations

from control_plant import quaternion_of, rotation_zyx

from companion.config.settings import load_profile, select_gains
from companion.control.laws import LAWS
from companion.control.registry import build_law
from companion.control.structs import ControlLevel, Reference, VehicleState

LAW_NAMES = tuple(LAWS)
LEVELS = tuple(ControlLevel)
QBALL2 = load_profile("qball2")
MASS_ESTIMATE = 0.7 * 1.79


def gains_of(name, level, **position_loop):
    """The shipped gains with changes to the position loop."""
    gains = select_gains(QBALL2, name, level.value)
    loop = gains.position_loop.model_copy(update=position_loop)
    return gains.model_copy(update={"position_loop": loop})


def law_of(name="dtlannc", level=ControlLevel.ATTITUDE, seed=1, profile=QBALL2, gains=None):
    return build_law(name, gains or gains_of(name, level), profile, level, seed)


def random_state(rng, tilt=0.3, yaw=3.0):
    roll, pitch = rng.uniform(-tilt, tilt, 2)
    return VehicleState(
        1.0,
        rng.normal(0, 1, 3),
        rng.normal(0, 1, 3),
        quaternion_of(rotation_zyx(roll, pitch, rng.uniform(-yaw, yaw))),
        rng.normal(0, 0.5, 3),
    )


def random_reference(rng):
    rows = [rng.normal(0, s, 3) for s in (1.0, 1.0, 1.0, 1.0, 2.0)]
    return Reference(*rows, *rng.normal(0, 0.5, 3))


def random_memory(rng, law, weights=0.3):
    """A memory in the middle of a flight."""
    array = law.initial_memory().to_array().copy()
    memory = type(law.initial_memory()).from_array(array, law.hidden)
    v = memory.values
    v["position_integral"] = rng.normal(0, 0.3, 3)
    v["attitude_integral"] = rng.normal(0, 0.02, 3)
    v["position_weights"] = rng.normal(0, weights, (law.hidden, 3))
    v["attitude_weights"] = rng.normal(0, 0.02, (law.hidden, 3))
    v["filter_angle"], v["filter_rate"] = rng.normal(0, 0.05, 3), rng.normal(0, 0.1, 3)
    v["feedback_rate"] = rng.normal(0, 1, 3)
    v["wrench"] = [15.0, *rng.normal(0, 0.05, 3)]
    v["started"] = 1.0
    return memory
