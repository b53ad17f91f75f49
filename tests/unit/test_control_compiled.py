"""Machine code against the same source run by Python, and the packing of what crosses into it."""

import numpy as np
import pytest
from control_cases import LAW_NAMES, LEVELS, law_of, random_memory, random_reference, random_state

from companion.control.compiled import compiled, python_twin
from companion.control.law import pack_input
from companion.control.packing import (
    INPUT,
    LOOP_GAINS,
    LOOP_TERMS,
    TERMS,
    Memory,
    memory_dtype,
    parameters_dtype,
)
from companion.control.structs import AdaptationGate


def run(kernel, law, memory, inputs):
    following, terms = np.zeros(1, memory_dtype(law.hidden)), np.zeros(1, TERMS)
    kernel(law.packed_parameters, memory, inputs, following, terms)
    return following, terms


def numbers(record, integers=0):
    values = np.frombuffer(record.tobytes(), dtype=np.float64)
    return values[: values.size - integers]


@pytest.mark.parametrize("name", LAW_NAMES)
@pytest.mark.parametrize("level", LEVELS)
def test_compiled_and_uncompiled_agree(name, level):
    """Over ten steps in a row, so that the memory's differences would add up."""
    law = law_of(name, level)
    twin = python_twin(law.kernel)
    assert not hasattr(twin, "py_func")
    rng = np.random.default_rng(LAW_NAMES.index(name) * 10 + LEVELS.index(level))
    start = random_memory(rng, law)
    fast, slow = start.packed, start.packed
    for k in range(10):
        gate = AdaptationGate.FREEZE if k == 5 else AdaptationGate.RUN
        inputs = pack_input(
            random_state(rng),
            random_reference(rng),
            rng.uniform(0.002, 0.05),
            gate,
            law.thrust_bounds_newton,
        ).view(INPUT)
        fast, fast_terms = run(law.kernel, law, fast, inputs)
        slow, slow_terms = run(twin, law, slow, inputs)
        assert fast_terms["bounds"] == slow_terms["bounds"]
        np.testing.assert_allclose(numbers(fast_terms, 1), numbers(slow_terms, 1), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(numbers(fast), numbers(slow), rtol=1e-12, atol=1e-12)


@compiled
def _inner(x):
    return 2.0 * x


@compiled
def _outer(x):
    return _inner(x) + 1.0


def test_the_twin_is_python_all_the_way_down():
    twin = python_twin(_outer)
    assert twin(3.0) == _outer(3.0) == 7.0
    assert not hasattr(twin.__globals__["_inner"], "py_func")


def test_inputs_stand_where_the_layout_says():
    rng = np.random.default_rng(0)
    state, ref = random_state(rng), random_reference(rng)
    record = pack_input(state, ref, 0.02, AdaptationGate.GROUND, (2.0, 40.0)).view(INPUT)[0]
    for field, value in {
        "position": state.position_enu,
        "velocity": state.velocity_enu,
        "quaternion": state.quaternion_wxyz,
        "body_rate": state.body_rate_flu,
        "reference_position": ref.position_enu,
        "reference_velocity": ref.velocity_enu,
        "reference_acceleration": ref.acceleration_enu,
        "reference_jerk": ref.jerk_enu,
        "reference_snap": ref.snap_enu,
        "reference_yaw": ref.yaw_rad,
        "reference_yaw_rate": ref.yaw_rate_rad_s,
        "reference_yaw_acceleration": ref.yaw_acceleration_rad_s2,
        "dt": 0.02,
        "gate": 3.0,
    }.items():
        np.testing.assert_array_equal(record[field], value, err_msg=field)


def test_memory_round_trip_and_flat_terms():
    law = law_of()
    memory = random_memory(np.random.default_rng(1), law)
    back = Memory.from_array(memory.to_array(), law.hidden)
    assert back.values.tobytes() == memory.values.tobytes()
    with pytest.raises(ValueError):
        Memory.from_array(memory.to_array()[:-1], law.hidden)
    rng = np.random.default_rng(2)
    terms = law.step(memory, random_state(rng), random_reference(rng), 0.01, AdaptationGate.RUN).terms
    flat = terms.flat()
    assert flat["position.error"].shape == (3,) and "attitude.lyapunov" in flat and "thrust" in flat
    assert sum(np.size(value) for value in flat.values()) * 8 == TERMS.itemsize


def test_record_fields_do_not_hide_behind_numpys_own_names():
    """`record.flags` is NumPy's, not ours: such a name reads wrong in Python and right in machine code."""
    for layout in (INPUT, TERMS, LOOP_GAINS, LOOP_TERMS, memory_dtype(3), parameters_dtype(3)):
        assert not [name for name in layout.names if hasattr(np.void, name)]
