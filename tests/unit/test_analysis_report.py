"""The comparison as the report prints it, and the HTML pages."""

import base64
import json
import re
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
import synthetic_flight

from companion.analysis.comparison import compare_logs
from companion.analysis.metrics import flight_metrics
from companion.analysis.published import PUBLISHED_RMS, improvement_percent
from companion.analysis.report import write_comparison_report, write_flight_report
from companion.cli.compare import show_comparison
from companion.config.errors import UserError
from companion.flightlog.reader import read_log
from companion.flightlog.writer import FlightLog

SCALES = {"tlmbc": 2.0, "nnsmc": 1.5, "dtlannc": 0.5}

# The P_imp columns of the report's table (control_laws.md section 7), typed from there.
PUBLISHED_IMPROVEMENT = {
    "nnsmc": [13.18, 15.57, -21.28, 14.27, -5.27, -116.55],
    "dtlannc": [46.79, 68.56, 15.60, 23.16, 8.40, 22.46],
}


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    return [
        synthetic_flight.write(
            folder / f"{name}{seed}.mcap", seconds=10.0, controller=name, seed=seed, scale=scale + 0.1 * seed
        )
        for name, scale in SCALES.items()
        for seed in (1, 2)
    ]


def test_p_imp_is_the_reports():
    base = PUBLISHED_RMS["tlmbc"]
    for name, column in PUBLISHED_IMPROVEMENT.items():
        ours = PUBLISHED_RMS[name]
        found = [
            improvement_percent(b, v)
            for key in ("position_m", "attitude_deg")
            for b, v in zip(base[key], ours[key], strict=True)
        ]
        assert found == pytest.approx(column, abs=0.02)  # the report's are cut, not rounded


def test_flights_are_averaged_by_controller_and_measured_against_tlmbc(logs):
    comparison = compare_logs(logs)
    assert [item.controller for item in comparison.results] == ["tlmbc", "nnsmc", "dtlannc"]
    assert comparison.judged_by == "truth" and comparison.notes == []
    rms = {item.controller: item.rms["position"] for item in comparison.results}
    c = synthetic_flight.ERROR_M[2]
    assert [rms[name][2] for name in SCALES] == pytest.approx([2.15 * c, 1.65 * c, 0.65 * c])
    improvement = comparison.results[2].improvement["position"]
    assert improvement == pytest.approx([100 * (1 - 0.65 / 2.15)] * 3, rel=1e-3)
    assert comparison.results[2].spread["position"][2] == pytest.approx(0.05 * c)


def test_what_makes_a_comparison_unfair_is_said(logs, tmp_path):
    other = synthetic_flight.write(
        tmp_path / "a.mcap", seconds=5.0, controller="nnsmc", seed=9, level="body_rate", truth=False
    )
    notes = " / ".join(compare_logs([logs[4], other]).notes)
    for word in ("level is", "same seeds", "no flight with tlmbc", "judged by the estimate"):
        assert word in notes


def test_nothing_to_compare_is_an_error(tmp_path):
    with pytest.raises(UserError, match="none of these logs"):
        compare_logs([synthetic_flight.write(tmp_path / "a.mcap", track=False)])


def test_one_log_without_tracking_is_left_out_of_a_comparison_with_a_note(logs, tmp_path):
    cut_early = synthetic_flight.write(tmp_path / "early.mcap", track=False)
    assert "early.mcap: not compared, no tracking in it" in compare_logs([logs[0], logs[0], cut_early]).notes


def test_compare_prints_json(logs, capsys):
    show_comparison(logs, as_json=True)
    out = json.loads(capsys.readouterr().out)
    assert out["controllers"]["dtlannc"]["improvement_percent"]["position_m"][0] > 60
    assert len(out["flights"]) == 6 and out["flights"][0]["controller"] == "tlmbc"


def test_compare_prints_the_table_within_eighty_columns(logs, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    show_comparison(logs)
    out = capsys.readouterr().out
    row = next(line for line in out.splitlines() if "e_x" in line)
    assert "…" not in out and "(0.0842)" in row and "69.7" in row


class Page(HTMLParser):
    """What an HTML file refers to, and whether its tags close."""

    VOID = ("meta", "img", "br", "hr", "link", "input")

    def __init__(self, text):
        super().__init__()
        self.open, self.sources, self.text, self.tags = [], [], [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.sources += [value for key, value in attrs if key in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def check_page(path):
    page = Page(path.read_text(encoding="utf-8"))
    assert page.open == []
    assert not page.tags & {"script", "link", "iframe"}
    assert page.sources and all(source.startswith("data:image/svg+xml;base64,") for source in page.sources)
    for source in page.sources:
        svg = base64.b64decode(source.partition(",")[2]).decode()
        assert "<svg" in svg and not re.search(r'(?:href|src)="(?!#)', svg)
    return page


def report(log, path, *window):
    record = read_log(log)
    metrics, tracking = flight_metrics(record, *window)
    write_flight_report(record, metrics, tracking, path)
    return check_page(path)


def test_the_report_stands_alone_and_holds_the_reports_figures(logs, tmp_path):
    page = report(logs[4], tmp_path / "r.html", 2.0, 8.0)
    text = " ".join(page.text)
    for words in (
        "Path, desired and flown",
        "e_p(t)",
        "e_η(t)",
        "Thrust and command",
        "Networks",
        "Timing",
        "profile.toml",
    ):
        assert words in text
    assert len(page.sources) == 10
    assert "0.0448" in text and "DTLANNC on the lemniscate" in text


@pytest.mark.parametrize("level", ["actuator", "body_rate"])
def test_other_levels_show_what_they_send(tmp_path, level):
    report(synthetic_flight.write(tmp_path / "a.mcap", seconds=2.0, level=level), tmp_path / "r.html")


def test_flights_without_tracking_truth_or_end_have_reports_too(tmp_path):
    log = synthetic_flight.write(tmp_path / "a.mcap", track=False, truth=False)
    page = report(log, tmp_path / "r.html")
    assert "never tracked" in " ".join(page.text)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-3000])
    assert "was cut" in " ".join(report(cut, tmp_path / "c.html").text)


def test_an_empty_log_has_a_report(tmp_path):
    with FlightLog(tmp_path / "a.mcap", {"controller": "dtlannc"}) as log:
        log.event("ended", 1.0, outcome="refused", text="not armed")
    record = read_log(tmp_path / "a.mcap")
    metrics, tracking = flight_metrics(record)
    write_flight_report(record, metrics, tracking, tmp_path / "r.html")
    assert metrics.ended == "refused" and "not armed" in (tmp_path / "r.html").read_text()


def test_what_stands_in_a_log_is_text_in_the_report(tmp_path):
    evil = "<script>alert(1)</script>"
    with FlightLog(tmp_path / "a.mcap", {"controller": evil}, {"x.toml": evil}) as log:
        log.event("warning", 1.0, text=evil)
    record = read_log(tmp_path / "a.mcap")
    write_flight_report(record, *flight_metrics(record), tmp_path / "r.html")
    assert "<script" not in (tmp_path / "r.html").read_text()


def test_the_same_log_gives_the_same_report(logs, tmp_path):
    for name in ("a", "b"):
        record = read_log(logs[0])
        write_flight_report(record, flight_metrics(record, 2.0, 3.0)[0], None, tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_the_comparison_has_a_report(logs, tmp_path):
    write_comparison_report(compare_logs(logs), tmp_path / "c.html")
    page = check_page(tmp_path / "c.html")
    assert len(page.sources) == 4 and "P_imp" in " ".join(page.text)


@pytest.mark.parametrize("missing", ["jinja2", "matplotlib"])
def test_without_the_report_extra_the_remedy_is_named(logs, tmp_path, monkeypatch, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    record = read_log(logs[0])
    with pytest.raises(UserError, match=re.escape("pip install 'dtlannc-companion[report]'")):
        write_flight_report(record, *flight_metrics(record), tmp_path / "r.html")


def test_a_report_that_cannot_be_written_is_an_error_of_the_user(logs, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write the report"):
        write_comparison_report(compare_logs(logs[:1]), tmp_path / "file" / "r.html")


def test_thinning_keeps_the_peaks():
    from companion.analysis.figures import thin

    time = np.arange(50_000.0)
    values = np.zeros(50_000)
    values[[1234, 40_001]] = 7.0, -3.0
    few_times, few = thin(time, values)
    assert len(few) <= 5000 and few.max() == 7.0 and few.min() == -3.0
    assert (np.diff(few_times) > 0).all()
