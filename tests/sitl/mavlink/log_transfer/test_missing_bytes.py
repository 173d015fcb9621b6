"""Ranges of missing bytes, compared with a plain set of numbers."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mimopilot.sitl.mavlink.log_transfer.missing_bytes import MissingBytes

SIZE = 60
PLACES = st.integers(0, SIZE)


@given(st.lists(st.tuples(PLACES, PLACES)))
def test_what_is_removed_is_no_longer_missing_and_is_counted_once(removals):
    missing, expected = MissingBytes([(0, SIZE)]), set(range(SIZE))
    for start, end in removals:
        assert missing.remove(start, end) == len(expected & set(range(start, end)))
        expected -= set(range(start, end))
        assert {k for a, b in missing.ranges() for k in range(a, b)} == expected
        assert (missing.total, bool(missing)) == (len(expected), bool(expected))
        again = MissingBytes(missing.ranges())
        assert again.ranges() == missing.ranges()
    pieces = missing.pieces(7, 1000)
    assert [k for start, length in pieces for k in range(start, start + length)] == sorted(expected)
    assert all(0 < length <= 7 for _, length in pieces)
    assert missing.pieces(7, 2) == pieces[:2]


def test_a_span_covers_short_received_gaps_and_is_bounded():
    missing = MissingBytes([(10, 20), (25, 30), (50, 60)])
    assert missing.span(5, 100) == (10, 30)
    assert missing.span(4, 100) == (10, 20)
    assert missing.span(20, 100) == (10, 60)
    assert missing.span(20, 17) == (10, 27)


@pytest.mark.parametrize("ranges", [[(5, 5)], [(-1, 3)], [(0, 10), (9, 12)], [(7, 3)]])
def test_ranges_that_are_none_are_refused(ranges):
    with pytest.raises(ValueError, match="expected ascending ranges"):
        MissingBytes(ranges)
