"""The search finds minima it cannot know, stays in its cube, repeats itself, and keeps what it found."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config.errors import UserError
from companion.config.gains import LoopGains
from companion.config.search_space import search_space, with_vector
from companion.config.settings import load_profile
from companion.tuning.search import Search
from companion.tuning.session import STANDARD_START, Tuning, certified, standard_start


def minimum(cost, start, generations, seed=1):
    search = Search(start, seed=seed)
    for _ in range(generations):
        points = search.ask()
        assert ((points >= 0.0) & (points <= 1.0)).all()
        search.tell(np.array([cost(point) for point in points]))
    return search


def test_finds_the_bottom_of_a_stretched_and_turned_bowl():
    """Condition number 100, axes mixed by a rotation: what a coordinate-wise search is slow on."""
    rng = np.random.default_rng(5)
    Q, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    H = Q @ np.diag(10.0 ** np.linspace(0, 2, 6)) @ Q.T
    target = np.linspace(0.3, 0.7, 6)
    found = minimum(lambda x: (x - target) @ H @ (x - target), np.full(6, 0.5), 150)
    assert found.best == pytest.approx(target, abs=1e-3)


def test_a_minimum_outside_ends_on_the_face():
    found = minimum(lambda x: float(np.sum((x - np.array([1.4, 0.5, -0.3])) ** 2)), np.full(3, 0.5), 80)
    assert found.best == pytest.approx([1.0, 0.5, 0.0], abs=5e-3)


def test_the_start_is_flown_first_and_seeds_repeat():
    one, two, other = (Search(np.array([0.2, 0.8]), seed=seed) for seed in (3, 3, 4))
    first = one.ask()
    assert first[0] == pytest.approx([0.2, 0.8])
    assert (first == two.ask()).all()
    assert (first != other.ask())[1:].any()


@given(
    alpha=st.floats(0.01, 5.0),
    kappa=st.floats(1e-3, 3.0),
    bound=st.floats(0.1, 30.0),
    rest=st.floats(0.0, 2.0),
)
@settings(max_examples=100)
def test_certified_gains_meet_the_propositions(alpha, kappa, bound, rest):
    """α ≥ κ W_max²/4 + ε_max (control_laws.md, section 5), and neither bound is ever raised."""
    loop = LoopGains(
        K_e=(1, 1, 1), K_U=(1, 1, 1), alpha=alpha, kappa=kappa, weight_bound=bound, residual_bound=rest
    )
    out = certified(loop)
    assert alpha * 1.0005 >= kappa * out.weight_bound**2 / 4 + out.residual_bound or out.weight_bound == 1e-3
    assert out.weight_bound <= max(bound, 1e-3)
    assert out.residual_bound <= rest * 1.0005


def test_standard_start_is_the_table_in_real_units():
    """K_U of 1.12 per kg on 1.79 kg is 2.005; of 8 per kg·m² on 0.03 kg·m² is 0.24. Every parameter has an entry."""
    profile = load_profile("qball2")
    space = search_space("actuator", has_network=True, has_integral=True)
    gains = with_vector(space, profile.controllers["dtlannc"].actuator, profile, standard_start(space))
    assert gains.position_loop.K_U[:2] == pytest.approx((2.005, 2.005), rel=1e-3)
    assert gains.attitude_loop.K_U[:2] == pytest.approx((0.24, 0.24), rel=1e-3)
    assert gains.attitude_loop.K_U[2] == pytest.approx(0.16, rel=1e-3)
    assert gains.command_filter_rad_s == pytest.approx(12.0, rel=1e-3)
    attitude = search_space("attitude", has_network=True, has_integral=True)
    assert {p.name for p in (*space, *attitude)} == set(STANDARD_START)


class Bowl:
    """An objective with a known best, in place of flights: K_U,xy = 4 N·s/m and feedback lead 0.2 s."""

    flights = 0

    def __init__(self, interrupt_at=math.inf):
        self.interrupt_at = interrupt_at

    def __call__(self, gains):
        self.flights += 1
        if self.flights >= self.interrupt_at:
            raise KeyboardInterrupt
        return (math.log(gains.position_loop.K_U[0] / 4.0)) ** 2 + (gains.lead.feedback_s - 0.2) ** 2 * 100


def tuning(tmp_path, objective, **options):
    profile = load_profile("qball2")
    start = profile.controllers["tlmbc"].attitude
    return Tuning(profile, "tlmbc", "attitude", objective, start, 1, tmp_path / "state.json", **options)


def test_a_run_finds_gains_and_reports(tmp_path):
    heard = []
    tuned = tuning(tmp_path, Bowl()).run(400, heard.append)
    assert tuned.gains.position_loop.K_U[0] == pytest.approx(4.0, rel=0.02)
    assert tuned.gains.lead.feedback_s == pytest.approx(0.2, abs=0.005)
    assert tuned.gains.position_loop.K_U[0] == tuned.gains.position_loop.K_U[1]
    costs = [progress.best_cost for progress in heard]
    assert costs == sorted(costs, reverse=True) and tuned.cost == costs[-1] < tuned.start_cost
    assert not tuned.stopped


def test_ctrl_c_keeps_the_best_and_a_later_run_goes_on(tmp_path):
    stopped = tuning(tmp_path, Bowl(interrupt_at=150)).run(400, lambda _: None)
    assert stopped.stopped and stopped.cost < stopped.start_cost
    kept = json.loads((tmp_path / "state.json").read_text())
    assert kept["cost"] == stopped.cost
    resumed = tuning(tmp_path, Bowl()).run(8, lambda _: None)
    assert resumed.start_cost == pytest.approx(stopped.cost, rel=1e-6)


def test_a_state_file_of_another_search_is_refused(tmp_path):
    (tmp_path / "state.json").write_text(
        json.dumps({"controller": "nnsmc", "level": "attitude", "profile": "qball2"})
    )
    with pytest.raises(UserError, match="nnsmc at level attitude"):
        tuning(tmp_path, Bowl())
    (tmp_path / "state.json").write_text("{")
    with pytest.raises(UserError, match="is not the state"):
        tuning(tmp_path, Bowl())
