"""Whatever is logged is read back, bit by bit, by us and by the mcap package."""

import math
import string
import tempfile
from pathlib import Path

import numpy as np
import pytest
import synthetic_flight
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from pymavlink import mavutil

from companion.config.errors import UserError
from companion.flightlog.channels import ESTIMATES, REFERENCE, STATE, ChannelSpec, FieldSpec
from companion.flightlog.digest import differences, digest, digests
from companion.flightlog.reader import read_log
from companion.flightlog.tlog import export_tlog
from companion.flightlog.writer import FlightLog

words = st.text(string.ascii_lowercase, min_size=1, max_size=8)
times = st.floats(0, 1e5)
json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False)
    | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=6,
)


@st.composite
def channels(draw):
    names = draw(st.lists(words.filter(lambda w: w != "time"), min_size=1, max_size=5, unique=True))
    fields = tuple(FieldSpec(f"{name}x", draw(st.integers(1, 6)), draw(words)) for name in names)
    return ChannelSpec("/" + draw(words.filter(lambda w: w not in ("events", "path", "tf"))), fields)


@settings(max_examples=40, deadline=None)
@given(data=st.data(), spec=channels())
def test_every_kind_of_record_comes_back(data, spec):
    rows = data.draw(
        st.lists(
            st.tuples(times, st.lists(st.floats(width=64), min_size=spec.width, max_size=spec.width)),
            max_size=20,
        )
    )
    happened = data.draw(
        st.lists(st.tuples(words, times, st.dictionaries(words, json_values, max_size=3)), max_size=5)
    )
    happened = [
        (kind, t, {k: v for k, v in f.items() if k not in ("kind", "time_s")}) for kind, t, f in happened
    ]
    frames = data.draw(
        st.lists(st.tuples(st.sampled_from(["in", "out"]), times, st.binary(max_size=280)), max_size=5)
    )
    facts = data.draw(st.dictionaries(st.text(max_size=5), st.text(max_size=20), max_size=3))
    content = data.draw(st.binary(max_size=300))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.mcap"
        with FlightLog(path, facts, {"file.bin": content}, channels=[spec], utc_offset_ns=7) as log:
            channel = log.define(spec)
            for time_s, row in rows:
                log.record(channel, time_s, np.array(row))
            for kind, time_s, fields in happened:
                log._put("event", kind, time_s, fields)
            for direction, time_s, frame in frames:
                log.mavlink(direction, time_s, frame)
        assert log.close().complete
        record = read_log(path)
    assert record.cut == ""
    assert record.flight == facts and record.attachments == {"file.bin": content}
    if rows:
        table = record.channels[spec.topic]
        assert table.time_s.tobytes() == np.array([t for t, _ in rows]).tobytes()
        assert table.values.tobytes() == np.array([row for _, row in rows]).tobytes()
        first = spec.fields[0]
        assert table[first.name].shape == ((len(rows),) if first.width == 1 else (len(rows), first.width))
    assert [(e.kind, e.time_s) for e in record.events] == [(kind, t) for kind, t, _ in happened]
    for event, (_, _, fields) in zip(record.events, happened, strict=True):
        assert event.fields == _finite(fields)
    for name in ("in", "out"):
        wanted = [frame for direction, _, frame in frames if direction == name]
        assert record.mavlink.get(name, (None, []))[1] == wanted


def _finite(value):
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, list):
        return [_finite(item) for item in value]
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    return value


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return synthetic_flight.write(tmp_path_factory.mktemp("log") / "flight.mcap", seconds=4.0)


def test_the_mcap_package_agrees_with_every_checksum_and_index(flight):
    with flight.open("rb") as file:
        records = list(StreamReader(file, validate_crcs=True).records)
    with flight.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        counts = {}
        for _, channel, _ in reader.iter_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
        some = list(
            reader.iter_messages(
                topics=["/state"], starting_at=synthetic_flight.UTC_OFFSET_NS + 15_000_000_000
            )
        )
        assert {item.name for item in reader.iter_attachments()} == {"settings.toml", "profile.toml"}
    record = read_log(flight)
    assert summary.statistics.message_count == sum(type(item).__name__ == "Message" for item in records)
    for topic, channel in record.channels.items():
        assert counts[topic] == len(channel)
    assert len(some) == int((record.channels["/state"].time_s >= 15.0).sum())


def test_poses_are_in_foxgloves_schemas_at_an_eyes_rate(flight):
    with flight.open("rb") as file:
        summary = make_reader(file).get_summary()
    schemas = {c.topic: summary.schemas[c.schema_id] for c in summary.channels.values()}
    assert (
        schemas["/pose/truth"].name == "foxglove.PoseInFrame"
        and schemas["/pose/truth"].encoding == "protobuf"
    )
    assert (
        schemas["/tf"].name == "foxglove.FrameTransform" and schemas["/path"].name == "foxglove.SceneUpdate"
    )
    counts = {c.topic: summary.statistics.channel_message_counts[c.id] for c in summary.channels.values()}
    assert 9.0 * 25 <= counts["/pose/state"] <= 9.0 * 31  # 9 s of flight, some 30 a second


def test_a_pose_holds_the_logged_position(tmp_path):
    with FlightLog(tmp_path / "a.mcap", channels=[STATE], utc_offset_ns=0) as log:
        log.record(log.define(STATE), 1.0, np.array([1.25, -2.5, 3.75, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0.0]))
    with (tmp_path / "a.mcap").open("rb") as file:
        data = next(m.data for _, c, m in make_reader(file).iter_messages() if c.topic == "/pose/state")
    for number in (1.25, -2.5, 3.75):  # protobuf doubles stand in the bytes as they are
        assert np.float64(number).tobytes() in data


def test_records_in_parts_and_packed_are_the_same(tmp_path):
    numbers = np.arange(1.0, 15.0)
    with FlightLog(tmp_path / "a.mcap", channels=[STATE], utc_offset_ns=0) as log:
        channel = log.define(STATE)
        log.record(channel, 1.0, numbers)
        log.record(channel, 1.0, numbers[:3], numbers[3:6], numbers[6:10], numbers[10:13], np.float64(14))
        log.record(channel, 1.0, numbers[::-1][::-1].astype(np.float32))
    assert (read_log(tmp_path / "a.mcap").channels["/state"].values == np.arange(1.0, 15.0)).all()


def test_a_record_that_does_not_fit_is_counted_and_said_and_costs_nothing_else(tmp_path):
    with FlightLog(tmp_path / "a.mcap", channels=[STATE], utc_offset_ns=0) as log:
        channel = log.define(STATE)
        log.record(channel, 1.0, np.zeros(14))
        log.record(channel, 1.0, "text")
        log.record(channel, 1.0, np.zeros(13))
    health = log.close()
    assert health.rejected == 2 and not health.complete
    record = read_log(tmp_path / "a.mcap")
    assert len(record.channels["/state"]) == 1
    assert record.events_of("log")[-1].fields["rejected"] == 2


def test_a_full_queue_drops_and_says_so(tmp_path):
    log = FlightLog(
        tmp_path / "a.mcap", channels=[STATE], utc_offset_ns=0, queue_limit=50, flush_interval_s=30.0
    )
    channel = log.define(STATE)
    for i in range(100):
        log.record(channel, 0.004 * i, np.zeros(14))
    health = log.close()
    record = read_log(tmp_path / "a.mcap")
    assert health.dropped + len(record.channels["/state"]) == 100 and health.dropped >= 50
    assert record.events_of("log")[-1].fields["dropped"] == health.dropped


def test_a_topic_has_one_layout(tmp_path):
    with FlightLog(tmp_path / "a.mcap", channels=[STATE]) as log:
        assert log.define(STATE) is log.define(STATE)
        with pytest.raises(ValueError, match="/state"):
            log.define(ChannelSpec("/state", (FieldSpec("a"),)))


def test_times_that_are_none_do_not_stop_the_log(tmp_path):
    with FlightLog(tmp_path / "a.mcap", channels=[REFERENCE], utc_offset_ns=0) as log:
        channel = log.define(REFERENCE)
        for time_s in (1.0, math.nan, math.inf, -5.0, 1e30, 2.0):
            log.record(channel, time_s, np.zeros(19))
            log.event("warning", time_s, text="x")
    record = read_log(tmp_path / "a.mcap")
    assert record.cut == "" and record.channels["/reference"].time_s[-1] == 2.0


def test_tlog_is_read_by_pymavlink(tmp_path):
    mav = mavutil.mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    frames = [mav.heartbeat_encode(2, 12, 0, i, 4).pack(mav) for i in range(6)]
    with FlightLog(tmp_path / "a.mcap", utc_offset_ns=1_700_000_000_000_000_000) as log:
        for i, frame in enumerate(frames):
            log.mavlink("in" if i % 2 else "out", 0.5 * i, frame)
    assert export_tlog(read_log(tmp_path / "a.mcap"), tmp_path / "a.tlog") == 6
    reader = mavutil.mavlink_connection(str(tmp_path / "a.tlog"))
    found = [reader.recv_msg() for _ in range(6)]
    assert [message.custom_mode for message in found] == list(range(6))
    assert [message._timestamp for message in found] == [1_700_000_000 + 0.5 * i for i in range(6)]


def test_digest_knows_what_counts(tmp_path):
    a = synthetic_flight.write(tmp_path / "a.mcap", seconds=1.0)
    same = synthetic_flight.write(tmp_path / "same.mcap", seconds=1.0)
    other = synthetic_flight.write(tmp_path / "other.mcap", seconds=1.0, scale=1.0 + 1e-15)
    assert digest(a) == digest(same)
    differing = {name for name in digests(a) if digests(a)[name] != digests(other)[name]}
    assert differing == {"/state", "/truth"}
    assert differences(a, same) == []
    assert [line.partition(":")[0] for line in differences(a, other)] == ["/state", "/truth"]
    assert "/timing" not in digests(a) and "metadata:wall" not in digests(a)


def test_digest_does_not_care_for_utc_or_the_clock_of_events(tmp_path):
    for name, offset, wall in (("a", 5, 1.0), ("b", 10**18, 2.0)):
        mav = mavutil.mavlink.MAVLink(None)
        with FlightLog(tmp_path / name, {"seed": "1"}, channels=[STATE], utc_offset_ns=offset) as log:
            log.record(log.define(STATE), 1.0, np.zeros(14))
            log.event("ended", 2.0, outcome="completed", wall_s=wall)
            log.record(log.define(ESTIMATES), 1.0, 0.5, wall, wall, 0.02, 12.0)
            mav.seq = int(wall)
            log.mavlink("in", 1.0, mav.timesync_encode(0, int(wall)).pack(mav))
            for old in (False, True):
                log.mavlink("in", 1.0, mav.heartbeat_encode(2, 12, 0, 7, 4).pack(mav, force_mavlink1=old))
    assert digest(tmp_path / "a") == digest(tmp_path / "b")
    assert differences(tmp_path / "a", tmp_path / "b") == []


def test_digest_does_care_for_everything_else(tmp_path):
    mav = mavutil.mavlink.MAVLink(None)
    found = set()
    for i, (hover, battery, custom_mode) in enumerate(
        [(0.5, 12.0, 1), (0.6, 12.0, 1), (0.5, 11.0, 1), (0.5, 12.0, 2)]
    ):
        path = tmp_path / f"{i}.mcap"
        with FlightLog(path, utc_offset_ns=0) as log:
            log.record(log.define(ESTIMATES), 1.0, hover, 1.0, 2.0, 0.02, battery)
            mav.seq = 0
            log.mavlink("out", 1.0, mav.heartbeat_encode(2, 12, 0, custom_mode, 4).pack(mav))
        found.add(digest(path))
    assert len(found) == 4
    assert differences(tmp_path / "0.mcap", tmp_path / "3.mcap") == [
        "/mavlink/out: record 0 at 1.000000 s; 1 and 1 records"
    ]


@pytest.mark.parametrize("content", [b"", b"\x89MC", b"not a log at all, but long enough", b"\x89MCAP0\r\n"])
def test_what_is_no_log_is_said_in_one_sentence(tmp_path, content):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"x\.mcap"):
        read_log(path)


def test_a_missing_log_is_said_in_one_sentence(tmp_path):
    with pytest.raises(UserError, match="No such file"):
        read_log(tmp_path / "nothing.mcap")


def test_existing_and_unwritable_places_are_refused_at_start(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"precious")
    with pytest.raises(UserError, match="exists already"):
        FlightLog(tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == b"precious"
    with pytest.raises(UserError, match="choose a folder"):
        FlightLog(tmp_path / "a.mcap" / "b.mcap")
    with pytest.raises(UserError, match="no room"):
        FlightLog(tmp_path / "b.mcap", minimum_free_bytes=1 << 60)
    assert not (tmp_path / "b.mcap").exists()
