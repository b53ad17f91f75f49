"""The propositions' conditions, with numbers worked out by hand."""

import numpy as np
import pytest
from control_cases import QBALL2, gains_of, law_of

from companion.config.gains import LoopGains
from companion.control.certificates import broken_conditions, condition
from companion.control.lyapunov import lyapunov
from companion.control.structs import ControlLevel


def loop(**changes):
    return LoopGains(K_e=(1, 1, 1), K_U=(1, 1, 1), N=1.0, **changes)


@pytest.mark.parametrize(
    ("alpha", "kappa", "bound", "residual", "holds", "strict"),
    [
        # needed: κ W²/4 + ε; the report's stricter form: κ W² + ε
        (1.0, 0.1, 4.0, 0.5, True, False),  # 0.9; 2.1
        (0.9, 0.1, 4.0, 0.5, True, False),
        (0.89, 0.1, 4.0, 0.5, False, False),
        (2.1, 0.1, 4.0, 0.5, True, True),
        (0.0, 0.0, 4.0, 0.0, True, True),
    ],
)
def test_condition(alpha, kappa, bound, residual, holds, strict):
    found = condition(loop(alpha=alpha, kappa=kappa, weight_bound=bound, residual_bound=residual), 1)
    assert (found.holds, found.strict) == (holds, strict)


@pytest.mark.parametrize(
    ("alpha", "width", "layer"),
    [
        (1.0, 0.0, 0.0),  # the exact sign, condition met: to zero
        (0.5, 0.0, 0.4),  # the exact sign, 0.4 short of 0.9 at K_U = 1
        (1.0, 0.1, 0.2433),  # r² + 0.1 r = 0.8355 · 0.1
        (0.5, 0.1, 0.4860),  # r² − 0.4 r = 0.8355 · 0.05
    ],
)
def test_the_layer_that_is_proven(alpha, width, layer):
    gains = loop(alpha=alpha, kappa=0.1, weight_bound=4.0, residual_bound=0.5, boundary_width=width)
    assert condition(gains, 1).layer == pytest.approx(layer, abs=1e-4)


def test_warning_names_both_sides():
    level = ControlLevel.ATTITUDE
    gains = gains_of("dtlannc", level, alpha=0.25, kappa=0.5, weight_bound=4.0, residual_bound=0.1)
    (warning,) = law_of("dtlannc", level, gains=gains).warnings
    assert "Proposition 1" in warning and "0.25 N" in warning and "2.1 N" in warning


def test_attitude_loop_counts_where_it_flies():
    gains = gains_of("dtlannc", ControlLevel.ACTUATOR)
    poor = gains.model_copy(update={"attitude_loop": gains.attitude_loop.model_copy(update={"alpha": 0.0})})
    assert any("Proposition 2" in text for text in broken_conditions(poor, attitude_loop_flies=True))
    assert not any("Proposition 2" in text for text in broken_conditions(poor, attitude_loop_flies=False))


def test_a_law_without_a_network_has_no_condition():
    assert law_of("tlmbc").warnings == ()


@pytest.mark.parametrize("name", ["dtlannc", "nnsmc"])
@pytest.mark.parametrize("level", list(ControlLevel))
def test_shipped_gains_meet_the_propositions(name, level):
    assert law_of(name, level, profile=QBALL2).warnings == ()


def test_lyapunov_by_hand():
    """β/2 e² + ½ Ũ·p + ½ K_i ξ² + d²/(2N): ½(2·1 + 3·6 + 4·0.25 + 9/1.5)."""
    e, U, p = np.array([1.0, 0, 0]), np.array([0, 3.0, 0]), np.array([0, 6.0, 0])
    xi, K_i = np.array([0, 0, 0.5]), np.array([9.0, 9.0, 4.0])
    assert lyapunov(e, U, p, xi, K_i, 3.0, 1.5, 2.0) == pytest.approx(0.5 * (2 + 18 + 1 + 6))
    assert lyapunov(e, U, p, xi, K_i, 3.0, 0.0, 2.0) == pytest.approx(0.5 * (2 + 18 + 1))
