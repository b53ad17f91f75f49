"""Names, options and files: what is understood, and that every mistake is said with its place."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config.errors import UserError
from companion.reference.circle import Circle
from companion.reference.hold import Hold
from companion.reference.lemniscate import Lemniscate
from companion.reference.registry import CATALOGUE, describe_trajectories, trajectory_from_text
from companion.reference.step import Step


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("lemniscate", Lemniscate()),
        (" lemniscate , scale = 0.5 ", Lemniscate(scale=0.5)),
        ("lemniscate,height=2,x_period=5,duration=inf", Lemniscate(height_m=2.0, x_period_s=5.0)),
        ("hover,height_m=1.5,yaw_deg=90", Hold(height_m=1.5, yaw_rad=math.pi / 2)),
        ("circle,radius=2,look_ahead=yes", Circle(radius_m=2.0, look_ahead=True)),
        ("circle,speed_m_s=2,clockwise=false", Circle(speed_m_s=2.0)),
        ("step,x=0,yaw=0.3", Step(x_m=0.0, yaw_rad=0.3)),
    ],
)
def test_names_and_options(text: str, expected: object) -> None:
    assert trajectory_from_text(text) == expected


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("lemniskate", ("lemniskate", "did you mean 'lemniscate'", "circle")),
        ("", ("Known are", "lemniscate")),
        ("lemniscate,radius=1", ("no option 'radius'", "x_amplitude_m")),
        ("lemniscate,scael=1", ("did you mean 'scale'",)),
        ("lemniscate,scale=big", ("scale", "number", "'big'")),
        ("lemniscate,scale=nan", ("scale=nan", "out of range")),
        ("lemniscate,x_period=1e-300", ("x_period=1e-300", "out of range")),
        ("lemniscate,speed=1e300", ("speed=1e300", "out of range")),
        ("lemniscate,scale=1,scale=2", ("'scale' is given twice",)),
        ("lemniscate,x_period=0", ("x_period_s is 0", "above 0")),
        ("circle,look_ahead=maybe", ("look_ahead", "true or false")),
        ("circle:file.csv", ("reads no file",)),
        ("csv", ("csv:FILE",)),
        ("waypoints:", ("waypoints:FILE",)),
        ("csv:/nowhere/at/all.csv", ("/nowhere/at/all.csv", "no such file")),
        ("path/to/tour.yaml", ("path/to/tour.yaml", "tour.yaml", ".toml")),
    ],
)
def test_mistakes_in_the_text(text: str, parts: tuple[str, ...]) -> None:
    with pytest.raises(UserError) as error:
        trajectory_from_text(text)
    for part in parts:
        assert part in str(error.value)


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=40) | st.from_regex(r"(lemniscate|circle|step|csv:|hover)(,\w{1,9}=\S{0,6}){0,3}"))
def test_whatever_is_written_gives_a_trajectory_or_one_clear_error(text: str) -> None:
    try:
        trajectory = trajectory_from_text(text)
    except UserError as error:
        assert str(error)
    else:
        assert np.isfinite(trajectory.sample(0.1).position_enu).all()


def test_help_names_every_trajectory_and_its_options() -> None:
    text = describe_trajectories()
    for name in CATALOGUE:
        assert name in text
    assert "csv:FILE" in text
    assert "x_period_s=4" in text


def write(tmp_path: Path, name: str, text: str | bytes) -> Path:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def samples(header: str = "t,x,y,z", n: int = 8) -> str:
    return header + "\n" + "".join(f"{0.5 * i},{i},{i * i},1\n" for i in range(n))


def test_csv_goes_through_its_rows(tmp_path: Path) -> None:
    text = "# a comment\n\n t , X , y_m, z, yaw_deg\n"
    text += "".join(
        f"{10 + 0.5 * i}, {i}, {i**2}, 1, {math.remainder(170 + 10 * i, 360)}\n" for i in range(8)
    )
    trajectory = trajectory_from_text(f"csv:{write(tmp_path, 'a.csv', text)}")
    assert trajectory.duration_s == pytest.approx(3.5)
    for i in range(8):
        reference = trajectory.sample(0.5 * i)  # time runs from the first row
        np.testing.assert_allclose(reference.position_enu, [i, i * i, 1.0], atol=1e-9)
        assert reference.yaw_rad == pytest.approx(math.radians(170 + 10 * i), abs=1e-9)
    # x = 2t, y = 4t² between the rows as well: cubics have no snap.
    np.testing.assert_allclose(trajectory.sample(1.3).position_enu, [2.6, 4 * 1.3**2, 1.0], atol=1e-9)
    np.testing.assert_allclose(trajectory.sample(1.3).acceleration_enu, [0.0, 8.0, 0.0], atol=1e-7)


def test_csv_yaw_takes_the_short_way_across_half_a_turn(tmp_path: Path) -> None:
    text = "t,x,y,z,yaw\n" + "".join(
        f"{i},0,0,1,{math.remainder(3.0 + 0.1 * i, math.tau)}\n" for i in range(6)
    )
    trajectory = trajectory_from_text(str(write(tmp_path, "a.csv", text)))
    assert trajectory.sample(2.5).yaw_rad == pytest.approx(3.25, abs=1e-6)


def test_csv_velocities_are_met(tmp_path: Path) -> None:
    times = np.arange(0.0, 4.1, 0.4)
    text = "t,x,y,z,vx,vy,vz\n"
    text += "".join(f"{t},{math.sin(t)},{math.cos(t)},1,{math.cos(t)},{-math.sin(t)},0\n" for t in times)
    path = write(tmp_path, "a.csv", text)
    trajectory = trajectory_from_text(str(path))
    for t in times[:-1]:
        np.testing.assert_allclose(
            trajectory.sample(t).velocity_enu, [math.cos(t), -math.sin(t), 0.0], atol=1e-9
        )
    assert trajectory.sample(2.2).velocity_enu[0] == pytest.approx(math.cos(2.2), abs=1e-5)
    double = trajectory_from_text(f"csv:{path},speed=2")
    assert double.duration_s == pytest.approx(trajectory.duration_s / 2)
    np.testing.assert_allclose(
        double.sample(0.6).velocity_enu, 2 * trajectory.sample(1.2).velocity_enu, atol=1e-9
    )


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ("empty", "t, x, y, z")),
        ("t,x,y,z\n", ("0 rows", "at least 5")),
        (samples(n=4), ("4 rows", "at least 5", "waypoints:FILE")),
        ("t,x,y\n0,1,2\n", (":1:", "column z is missing")),
        ("0,0,0,1\n1,0,0,1\n", (":1:", "no header", "t,x,y,z")),
        (samples("t,x,y,zz"), (":1:", "column z is missing", "zz")),
        (samples("t,x,y,z,yaw_dg"), (":1:", "unknown column 'yaw_dg'", "did you mean")),
        ("t,x,y,z\n" + "".join(f"{17 + i}e17,0,0,1\n" for i in range(6)), (":2:", "ns", "seconds")),
        (samples("t,x,y,t"), (":1:", "twice")),
        (samples() + "4,nan,0,1\n", (":10:", "column x", "nan", "finite")),
        (samples() + "4,inf,0,1\n", (":10:", "column x", "inf")),
        (samples() + "4,,0,1\n", (":10:", "column x", "'' is not a number")),
        (samples() + "4,abc,0,1\n", (":10:", "'abc' is not a number")),
        (samples() + "4,0,1\n", (":10:", "3 values", "4 columns")),
        (samples() + "3.5,0,0,1\n", (":10:", "time 3.5 s", "3.5 s")),
        (samples() + "4,2e6,0,1\n", (":10:", "column x", "out of range")),
        (samples() + "3.5001,0,0,1\n", (":10:", "0.0001 s after", "0.001 s apart")),
        (samples() + "1,0,0,1\n", (":10:", "does not come after")),
        ("t,x,y,z,vx\n" + "".join(f"{i},0,0,1,0\n" for i in range(6)), ("vy, vz", "missing")),
        (
            "t,x,y,z,yaw,yaw_deg\n" + "".join(f"{i},0,0,1,0,0\n" for i in range(6)),
            ("both yaw and yaw_deg",),
        ),
        (b"\xff\xfe\x00\x01", ("not a text file",)),
        ('t,x,y,z\n0,"' + "9" * 140_000 + '",0,1\n', (":2:", "not a comma-separated table")),
    ],
)
def test_mistakes_in_a_csv_file(tmp_path: Path, text: str | bytes, parts: tuple[str, ...]) -> None:
    path = write(tmp_path, "bad.csv", text)
    with pytest.raises(UserError) as error:
        trajectory_from_text(f"csv:{path}")
    assert str(path) in str(error.value)
    for part in parts:
        assert part in str(error.value)


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("t,x,y,z", "{t},{x},0,1"),
        ("# t,x,y,z", "{t},{x},0,1"),
        ("# t x y z", "{t:.18e} {x:.18e} 0 1"),
        ("Time [s];pos_x [m];pos_y [m];pos_z [m]", "{t};{x};0;1"),
        ("time\tpx\tpy\tpz", "{t}\t{x}\t0\t1"),
        ("t,x,y,z,ax,battery", "{t},{x},0,1,9,fine"),
        ("t,x,y,z,", "{t},{x},0,1,"),
    ],
)
@pytest.mark.parametrize("start", [0.0, 1_764_540_000.0], ids=["from 0", "since 1970"])
def test_tables_of_other_tools(tmp_path: Path, header: str, row: str, start: float) -> None:
    rows = [row.format(t=start + 0.5 * i, x=0.25 * i) for i in range(8)]
    path = write(tmp_path, "other.csv", "\n".join([header, *rows]))
    trajectory = trajectory_from_text(str(path))
    assert trajectory.duration_s == pytest.approx(3.5)
    np.testing.assert_allclose(trajectory.sample(1.25).position_enu, [0.625, 0.0, 1.0], atol=1e-6)


def test_decimal_commas_between_semicolons(tmp_path: Path) -> None:
    text = "t;x;y;z\n" + "".join(f"{i},5;0,{i};0;1\n" for i in range(6))
    trajectory = trajectory_from_text(str(write(tmp_path, "a.csv", text)))
    assert trajectory.sample(3.0).position_enu[0] == pytest.approx(0.3)


def test_columns_passed_over_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = "t,x,y,z,battery\n" + "".join(f"{i},0,0,1,full\n" for i in range(6))
    for _ in range(2):
        trajectory_from_text(str(write(tmp_path, "a.csv", text)))
    assert capsys.readouterr().err.count("passed over: column battery") == 1


def test_polynomial_pieces_are_flown_as_they_are(tmp_path: Path) -> None:
    """x = t² then 4 + 4t; y and z of 7th order; yaw a turn off at the seam."""
    names = [f"{axis}^{n}" for axis in ("x", "y", "z", "yaw") for n in range(8)]
    first = [2.0, 0, 0, 1, *[0] * 5, *[0] * 7, 0.001, 1, *[0] * 7, 3, 0.1, *[0] * 6]
    second = [1.0, 4, 4, *[0] * 6, 0.128, *[0] * 7, 1, *[0] * 7, 3.2 - math.tau, *[0] * 7]
    text = (
        ",".join(["Duration", *names]) + "\n" + "".join(",".join(map(str, r)) + "\n" for r in (first, second))
    )
    path = write(tmp_path, "piece.csv", text)
    trajectory = trajectory_from_text(str(path))
    assert trajectory.duration_s == 3.0
    at = trajectory.sample(1.5)
    np.testing.assert_allclose(at.position_enu, [2.25, 0.001 * 1.5**7, 1.0], rtol=1e-12)
    np.testing.assert_allclose(at.velocity_enu, [3.0, 0.007 * 1.5**6, 0.0], rtol=1e-12)
    np.testing.assert_allclose(at.snap_enu, [0.0, 0.84 * 1.5**3, 0.0], atol=1e-12)
    assert at.yaw_rad == pytest.approx(3.15) and trajectory.sample(2.5).yaw_rad == pytest.approx(3.2)
    np.testing.assert_allclose(trajectory.sample(2.5).position_enu, [6.0, 0.128, 1.0], rtol=1e-12)
    slow = trajectory_from_text(f"csv:{path},speed=0.5")
    assert slow.duration_s == 6.0
    np.testing.assert_allclose(slow.sample(3.0).velocity_enu[0], 1.5, rtol=1e-12)


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be read"):
        trajectory_from_text(f"csv:{tmp_path}")


@settings(max_examples=100, deadline=None)
@given(content=st.text(alphabet="txyz,0123456789.-e+\n\"'# nai", max_size=120), header=st.booleans())
def test_any_csv_content_gives_a_trajectory_or_one_clear_error(
    tmp_path_factory: pytest.TempPathFactory, content: str, header: bool
) -> None:
    path = write(tmp_path_factory.getbasetemp(), "any.csv", ("t,x,y,z\n" if header else "") + content)
    try:
        trajectory = trajectory_from_text(f"csv:{path}")
    except UserError as error:
        assert "any.csv" in str(error)
    else:
        assert np.isfinite(trajectory.sample(0.5).position_enu).all()


TOUR = """
[limits]
speed_m_s = 1.5
[[waypoint]]
position = [0, 0, 1]
yaw_deg = 170
[[waypoint]]
position = [2.0, 0, 1.5]
yaw_deg = -170
[[waypoint]]
position = [2, 2, 1]
"""


def test_waypoints_from_toml(tmp_path: Path) -> None:
    path = write(tmp_path, "tour.toml", TOUR)
    trajectory = trajectory_from_text(str(path))
    knots = trajectory.knot_times_s  # type: ignore[attr-defined]
    np.testing.assert_allclose(trajectory.sample(knots[1]).position_enu, [2.0, 0.0, 1.5], atol=1e-9)
    assert trajectory.sample(0.0).yaw_rad == pytest.approx(math.radians(170))
    assert trajectory.sample(knots[1]).yaw_rad == pytest.approx(math.radians(190))  # the short way
    assert trajectory.sample(knots[2]).yaw_rad == pytest.approx(math.radians(190))  # kept where not given
    slower = trajectory_from_text(f"waypoints:{path},speed=0.3")
    assert slower.duration_s > trajectory.duration_s


def test_waypoints_with_times(tmp_path: Path) -> None:
    text = "x,y,z,t\n0,0,1,5\n1,0,1,7\n1,1,1,10\n"
    trajectory = trajectory_from_text(f"waypoints:{write(tmp_path, 'tour.csv', text)}")
    assert trajectory.duration_s == 5.0
    np.testing.assert_allclose(trajectory.sample(2.0).position_enu, [1.0, 0.0, 1.0], atol=1e-12)
    with pytest.raises(UserError, match="gives times"):
        trajectory_from_text(f"waypoints:{tmp_path / 'tour.csv'},speed=1")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ("0 waypoints",)),
        ("[[waypoint]]\nposition = [0, 0, 1]\n", ("1 waypoints", "from 2")),
        ("[[waypoint]\nposition = [0, 0, 1]\n", (":1:", "not valid TOML")),
        (TOUR + "\n[[waypoint]]\nposition = [1, 2]\n", (":13:", "three numbers")),
        (TOUR + "\n[[waypoint]]\nposition = [1, 2, nan]\n", (":13:", "finite")),
        (TOUR + f"\n[[waypoint]]\nposition = [1, 2, 1{'0' * 400}]\n", (":13:", "at most 1e+06")),
        (TOUR + "\n[[waypoint]]\nposition = [1, 2, true]\n", (":13:", "finite number", "not True")),
        (TOUR + "\n[[waypoint]]\nyaw_deg = 3\n", (":13:", "three numbers")),
        (TOUR + "\n[[waypoint]]\nposition = [1, 2, 3]\nspeed = 2\n", (":13:", "unknown entry 'speed'")),
        (TOUR + "\n[[waypoint]]\nposition = [1, 2, 3]\ntime_s = 2\n", (":13:", "for some waypoints only")),
        (TOUR + "\n[[waypoint]]\nposition = [2, 2, 1]\n", ("waypoints 3 and 4 are the same",)),
        (TOUR.replace("speed_m_s = 1.5", "speed = 1"), ("[limits] has no 'speed'", "speed_m_s")),
        (TOUR.replace("1.5\n[[", "0\n[[", 1), ("speed_m_s", "above 0")),
        ("waypoint = 3\n", ("[[waypoint]]",)),
        ("limits = 3\n", ("[limits]",)),
        ("route = 3\n", ("unknown entry 'route'",)),
        (
            "[[waypoint]]\nposition=[0,0,1]\ntime_s=1\n[[waypoint]]\nposition=[0,0,2]\ntime_s=1\n",
            (":4:", "does not come after"),
        ),
    ],
)
def test_mistakes_in_a_waypoint_file(tmp_path: Path, text: str, parts: tuple[str, ...]) -> None:
    path = write(tmp_path, "bad.toml", text)
    with pytest.raises(UserError) as error:
        trajectory_from_text(f"waypoints:{path}")
    assert str(path) in str(error.value)
    for part in parts:
        assert part in str(error.value)
