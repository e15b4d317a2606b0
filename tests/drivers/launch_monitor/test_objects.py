from __future__ import annotations

import json

from hypothesis import given
from hypothesis import strategies as st

from drivers.launch_monitor.conversation import MAX_DEPTH, MAX_OBJECT_SIZE, ObjectStream

OBJECTS = st.dictionaries(
    st.text(max_size=6),
    st.one_of(st.text(alphabet='{}"\\a ü', max_size=12), st.integers(), st.just({}), st.just({"a": "}"})),
    max_size=4,
)
BETWEEN = st.binary(max_size=5).map(lambda noise: noise.replace(b"{", b","))


@given(
    st.lists(st.tuples(BETWEEN, OBJECTS), max_size=6),
    st.lists(st.integers(1, 30), min_size=1, max_size=20),
    st.booleans(),
)
def test_object_stream_any_split_finds_objects(
    parts: list[tuple[bytes, dict[str, object]]], cuts: list[int], ascii_only: bool
) -> None:
    whole = [json.dumps(value, ensure_ascii=ascii_only).encode() for _, value in parts]
    data = b"".join(noise + text for (noise, _), text in zip(parts, whole, strict=True))
    stream, found, n = ObjectStream(), [], 0
    while data:
        cut = cuts[n % len(cuts)]
        found += stream.feed(data[:cut])
        data, n = data[cut:], n + 1
    assert found == whole
    assert stream.passed_over == sum(len(noise) for noise, _ in parts)
    assert stream.pending == 0


@given(st.lists(st.binary(max_size=40).map(lambda b: b.replace(b"q", b"{").replace(b"z", b'"')), max_size=20))
def test_object_stream_counts_every_byte_once(pieces: list[bytes]) -> None:
    stream, inside = ObjectStream(), 0
    for piece in pieces:
        inside += sum(map(len, stream.feed(piece)))
    if not stream.error:
        assert inside + stream.pending + stream.passed_over == sum(map(len, pieces))


def test_object_stream_endless_object_errors_and_keeps_earlier() -> None:
    stream = ObjectStream()
    assert stream.feed(b'{"a":1}{"b":"' + b"x" * (MAX_OBJECT_SIZE // 2)) == [b'{"a":1}']
    assert stream.error == ""
    assert stream.feed(b"x" * MAX_OBJECT_SIZE) == []
    assert str(MAX_OBJECT_SIZE) in stream.error
    assert stream.pending == 0
    assert stream.feed(b'{"a":1}') == []


def test_object_stream_oversized_object_is_refused() -> None:
    stream = ObjectStream()
    assert stream.feed(b'{"a":1}{"b":"' + b"x" * MAX_OBJECT_SIZE + b'"}{"c":2}') == [b'{"a":1}']
    assert stream.error


def test_object_stream_depth_beyond_limit_errors() -> None:
    stream = ObjectStream()
    deepest = b'{"a":' * (MAX_DEPTH - 1) + b"{}" + b"}" * (MAX_DEPTH - 1)
    assert stream.feed(deepest) == [deepest]
    stream.feed(b'{"a":' * (MAX_DEPTH + 1))
    assert "deep" in stream.error


def test_object_stream_drop_discards_pending() -> None:
    stream = ObjectStream()
    stream.feed(b'{"a":"')
    assert stream.pending == 6
    stream.drop()
    assert (stream.pending, stream.passed_over) == (0, 6)
    assert stream.feed(b'{"b":2}') == [b'{"b":2}']
