"""A calibration as a message: what comes back is what went in, and what is none is refused."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from modcal_interfaces.msg import Calibration
from rcl_interfaces.msg import Parameter

from modcal_core.errors import BadCommand, BadTable, ModcalError
from modcal_msgs_py.typed import calibration_data, fill_calibration

NUMBERS = st.floats(allow_nan=False) | st.integers(-(2**63), 2**63 - 1)
WORDS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=5)
KEYS = WORDS.map(str) | st.sampled_from(["a/b", "~1", "[0]", "~", "[", "x[1]/y~2"])
TREES = st.recursive(
    st.none() | st.booleans() | NUMBERS | WORDS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=20,
)


@given(st.dictionaries(KEYS, TREES, min_size=1, max_size=5))
def test_what_comes_back_is_what_went_in(data: dict[str, Any]) -> None:
    assert calibration_data(fill_calibration(Calibration(), Parameter, data)) == data


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (Calibration(version=2), "has version 2, 1 is read"),
        (Calibration(values=[Parameter(name="a"), Parameter(name="a/b")]), "lies below a value"),
        (Calibration(values=[Parameter(name="[0]")]), "is a list"),
    ],
)
def test_what_is_none_is_refused(message: Calibration, said: str) -> None:
    with pytest.raises(ModcalError, match=said) as caught:
        calibration_data(message)
    assert isinstance(caught.value, BadCommand | BadTable)
