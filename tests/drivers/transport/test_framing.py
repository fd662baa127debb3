"""The framer finds all true frames and no false ones, for any chunking and any noise."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from drivers.tfmini import command, data_framer
from drivers.transport.checks import sum_low_byte
from drivers.transport.framing import Framer


def frame(raw: int, strength: int = 500) -> bytes:
    body = b"\x59\x59" + raw.to_bytes(2, "little") + strength.to_bytes(2, "little") + b"\x00\x08"
    return body + bytes([sum_low_byte(body)])


def in_chunks(framer: Framer, data: bytes, cuts: list[int]) -> list[bytes]:
    places = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [found for a, b in pairwise(places) for found in framer.feed(data[a:b])]


frames = st.lists(st.integers(0, 0xFFFF).map(frame), max_size=6)


@given(frames, st.lists(st.integers(min_value=0), max_size=12))
def test_any_chunking_gives_the_same_frames(true_frames: list[bytes], cuts: list[int]) -> None:
    assert in_chunks(data_framer(), b"".join(true_frames), cuts) == true_frames


@given(st.binary(max_size=80), st.lists(st.integers(min_value=0), max_size=12))
def test_chunking_does_not_matter_for_any_bytes(data: bytes, cuts: list[int]) -> None:
    whole, pieces = data_framer(), data_framer()
    assert whole.feed(data) == in_chunks(pieces, data, cuts)
    assert whole.counts == pieces.counts
    assert whole.pending == pieces.pending


@given(st.binary(max_size=200))
def test_every_byte_is_a_frames_noise_or_pending(data: bytes) -> None:
    framer = data_framer()
    framer.feed(data)
    assert 9 * framer.counts.frames + framer.counts.noise + framer.pending == len(data)


def test_a_false_header_before_a_frame_does_not_hide_it() -> None:
    true = frame(0x5959, 0x5959)
    assert data_framer().feed(b"\x00\x59\x59\x59" + true + true) == [true, true]


def test_a_damaged_frame_is_counted_and_the_next_one_found() -> None:
    framer = data_framer()
    wrong = bytearray(frame(100))
    wrong[3] ^= 4
    assert framer.feed(bytes(wrong) + frame(101)) == [frame(101)]
    assert framer.counts.bad >= 1


def test_a_length_function_that_says_zero_skips_the_header() -> None:
    framer = Framer(b"\x5a", lambda d: None if len(d) < 2 else d[1], lambda f: True)
    assert framer.feed(b"\x5a\x00\x5a\x04\x01\x5f") == [command(1)]
