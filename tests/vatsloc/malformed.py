"""What the tests of malformed files share: junk for a field, and the only two ends that a reader may have."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from vatsloc.errors import CaseError, InputRefused

T = TypeVar("T")

WRONG_TEXT = (
    "", " ", "null", "None", "abc", "nan nan nan", "inf 1 1", "-1", "-1 -1 -1", "0", "0 0 0", "1,5 2,5 3,5", "1,5",
    "1 2", "1 2 3 4 5", "1e400", "99999999999999999999", "1000000 1000000 1000000", "(1,2)", "none none none",
    "1.5.2", "0x10", "True", "\u00e4", "[1, 2, 3]",
)  # fmt: skip
"""Nothing of this is a right value of any header's field that places or sizes something."""
junk = st.one_of(
    st.sampled_from(WRONG_TEXT), st.text(st.characters(codec="utf-8", exclude_characters="\n\r"), max_size=4)
)


def bounded(examples: int) -> settings:
    """The same examples in every run, few enough for seconds."""
    return settings(
        derandomize=True, max_examples=examples, deadline=None, database=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture],
    )  # fmt: skip


def read_or_refused(read: Callable[[], T], right: Callable[[T], bool]) -> bool:
    """Whether a reader refused, with one sentence; fails where it read something else or raised anything else."""
    try:
        got = read()
    except (CaseError, InputRefused) as refusal:
        sentence = str(refusal)
        assert sentence.endswith(".")
        assert "\n" not in sentence
        return True
    assert right(got), "read, but not right"
    return False
