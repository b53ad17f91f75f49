"""The channels of a control law: what a step was given, what it remembered, what it made of both.

/law_input and /law_memory (before the step) are all that a step depends on beside the settings, so that
`companion.analysis.replay` can repeat it and get the bits of /terms and of the next /law_memory. Both
networks' weights are fields of /law_memory.
"""

from __future__ import annotations

from companion.control.packing import INPUT, TERMS, memory_dtype
from companion.flightlog.channels import ChannelSpec, packed_channel

LAW_TEXT = "law.py"
"""The attachment that holds the text of a law of one's own."""
LATER_SETTINGS = "settings-from-"
"""Begins the names of attachments with the settings from a time on, s: `settings-from-12.345678.json`."""
INPUT_TOPIC, MEMORY_TOPIC, TERMS_TOPIC = "/law_input", "/law_memory", "/terms"

_STATE_UNITS = {
    "position": "m",
    "velocity": "m/s",
    "quaternion": "1",
    "body_rate": "rad/s",
    "reference_position": "m",
    "reference_velocity": "m/s",
    "reference_acceleration": "m/s^2",
    "reference_jerk": "m/s^3",
    "reference_snap": "m/s^4",
    "reference_yaw": "rad",
    "reference_yaw_rate": "rad/s",
    "reference_yaw_acceleration": "rad/s^2",
    "dt": "s",
    "thrust_min": "N",
    "thrust_max": "N",
    "time": "s",
}
_MEMORY_UNITS = {
    "position_integral": "m",
    "position_weights": "N",
    "attitude_integral": "rad",
    "attitude_weights": "N m",
    "filter_angle": "rad",
    "filter_rate": "rad/s",
    "feedback_rate": "N/s",
    "hand_over_force": "N",
    "hand_over_yaw": "rad",
}
_LOOP_UNITS = {
    "error": ("m", "rad"),
    "error_rate": ("m/s", "rad/s"),
    "u": ("m/s", "rad/s"),
    "u_error": ("m/s", "rad/s"),
    "u_rate": ("m/s^2", "rad/s^2"),
    "integral": ("m", "rad"),
    "proportional_term": ("N", "N m"),
    "integral_term": ("N", "N m"),
    "model_term": ("N", "N m"),
    "network_term": ("N", "N m"),
    "sign_term": ("N", "N m"),
    "total": ("N", "N m"),
    "weight_norm": ("N", "N m"),
}
_TERM_UNITS = {
    "hand_over_force": "N",
    "force": "N",
    "euler": "rad",
    "euler_rate": "rad/s",
    "euler_desired": "rad",
    "euler_rate_desired": "rad/s",
    "euler_acceleration_desired": "rad/s^2",
    "flat_euler": "rad",
    "flat_euler_rate": "rad/s",
    "flat_euler_acceleration": "rad/s^2",
    "feedback_lead_force": "N",
    "euler_setpoint": "rad",
    "thrust_wanted": "N",
    "thrust": "N",
    "quaternion": "1",
    "body_rate": "rad/s",
    "torque_wanted": "N m",
    "torque": "N m",
    "rotor_thrust": "N",
}


def input_channel() -> ChannelSpec:
    """Return the channel of `companion.control.packing.INPUT`."""
    return packed_channel(INPUT_TOPIC, INPUT, _STATE_UNITS)


def memory_channel(hidden: int) -> ChannelSpec:
    """Return the channel of a law's memory with `hidden` neurons a network: weights are (L, 3)."""
    return packed_channel(MEMORY_TOPIC, memory_dtype(hidden), _MEMORY_UNITS)


def law_terms_channel() -> ChannelSpec:
    """Return the channel of `companion.control.packing.TERMS`, names flattened: `position_u_error`."""
    loops = {
        f"{loop}_{name}": units[rank]
        for rank, loop in enumerate(("position", "attitude"))
        for name, units in _LOOP_UNITS.items()
    }
    return packed_channel(TERMS_TOPIC, TERMS, _TERM_UNITS | loops)
