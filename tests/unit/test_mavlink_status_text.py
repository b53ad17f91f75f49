"""STATUSTEXT that comes in chunks."""

from __future__ import annotations

from mavlink_wire import Sender, mav

from companion.mavlink.received import read
from companion.mavlink.status_text import StatusTexts

LONG = "é" * 24 + "x" + "é" * 40 + " end"  # the 50th byte is half of a letter


def chunks(text, number=7, sender=None):
    raw, sender = text.encode(), sender or Sender()
    return [
        read(sender.frame(mav.MAVLink_statustext_message(4, raw[at : at + 50], number, at // 50)))
        for at in range(0, len(raw), 50)
    ]


def heard(texts, messages):
    return [(each.severity, each.text) for m in messages for each in texts.take(m, 0.0)]


def test_chunks_in_any_order_make_one_text():
    parts = chunks(LONG)
    assert heard(StatusTexts(), parts) == [(4, LONG)]
    assert heard(StatusTexts(), [parts[0], *reversed(parts)]) == [(4, LONG)]


def test_two_senders_with_the_same_id_are_kept_apart():
    ours, theirs = chunks("a" * 60), chunks("b" * 60, sender=Sender(2))
    assert heard(StatusTexts(), [ours[0], theirs[0], theirs[1], ours[1]]) == [(4, "b" * 60), (4, "a" * 60)]


def test_a_missing_chunk_is_shown():
    texts, parts = StatusTexts(), chunks("a" * 50 + "b" * 50 + "c" * 10)
    assert heard(texts, [parts[0], parts[2]]) == [] and texts.overdue(0.5) == []
    assert [each.text for each in texts.overdue(2.0)] == ["a" * 50 + "[…]" + "c" * 10]
    assert heard(texts, [parts[0], *chunks("next", number=8)]) == [(4, "a" * 50 + "[…]"), (4, "next")]
