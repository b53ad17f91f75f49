import numpy as np
import pytest

from companion.control.packing import INPUT, TERMS, memory_dtype
from companion.flightlog.channels import (
    REFERENCE,
    STATE,
    TRUTH,
    ChannelSpec,
    FieldSpec,
    packed_channel,
    parse_definition,
    terms_channel,
)


def test_definition_carries_type_unit_and_shape():
    text = ChannelSpec(
        "/weights/position", (FieldSpec("w", 6, "N", "W", (2, 3)), FieldSpec("n", kind="int64"))
    ).definition()
    assert text.splitlines()[1] == "float64[6] w  # [N]; shape 2x3; W"
    assert text.splitlines()[2] == "int64 n"
    assert text.splitlines()[0].startswith("float64 time_s  # [s]")


@pytest.mark.parametrize(
    "spec", [STATE, REFERENCE, TRUTH, packed_channel("/terms", TERMS), packed_channel("/i", INPUT)]
)
def test_definition_reads_back(spec):
    fields = parse_definition(spec.definition())
    assert fields[0].name == "time_s"
    assert [(f.name, f.width, f.unit, f.shape, f.kind) for f in fields[1:]] == [
        (f.name, f.width, f.unit, f.shape, f.kind) for f in spec.fields
    ]


def test_packed_record_is_laid_out_as_its_fields():
    spec = packed_channel("/memory", memory_dtype(4), {"position_weights": "N"})
    record = np.zeros((), memory_dtype(4))[()]
    record["position_weights"] = np.arange(12).reshape(4, 3)
    flat = np.frombuffer(record.tobytes())
    assert flat[spec.slice_of("position_weights")].tolist() == list(range(12))
    weights = next(item for item in spec.fields if item.name == "position_weights")
    assert (weights.shape, weights.unit) == ((4, 3), "N")


def test_terms_layout_and_packed_record_give_the_same_names():
    names = [item.name for item in packed_channel("/terms", TERMS).fields]
    assert "position_u_error" in names and "attitude_lyapunov" in names
    assert terms_channel([("position.U_error", 3, "m/s")]).fields[0].name == "position_u_error"


@pytest.mark.parametrize(
    "make",
    [
        lambda: FieldSpec("Upper"),
        lambda: FieldSpec("a__b"),
        lambda: FieldSpec("a", 0),
        lambda: FieldSpec("a", 5, shape=(2, 3)),
        lambda: FieldSpec("a", kind="float32"),
        lambda: ChannelSpec("state", (FieldSpec("a"),)),
        lambda: ChannelSpec("/a", (FieldSpec("a"), FieldSpec("a"))),
        lambda: ChannelSpec("/a", (FieldSpec("time_s"),)),
        lambda: ChannelSpec("/a", (FieldSpec("p", 2),), pose=("p", None)),
        lambda: packed_channel("/a", np.dtype([("a", "i4"), ("b", "f8")], align=True)),
    ],
)
def test_what_would_not_survive_in_the_file_is_refused(make):
    with pytest.raises(ValueError):
        make()


@pytest.mark.parametrize("text", ["float32 a", "float64[] a", "string s", "float64[999] ", "a\nb"])
def test_other_programs_definitions_are_not_ours(text):
    with pytest.raises(ValueError):
        parse_definition(text)
