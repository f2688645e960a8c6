"""Exit codes that the case format promises."""

from __future__ import annotations

import pytest

from vatsloc.errors import CaseError, GateFailed, InputRefused, NotConverged, VatslocError


@pytest.mark.parametrize(("error", "code"), [(CaseError, 2), (InputRefused, 3), (NotConverged, 4), (GateFailed, 5)])
def test_each_error_carries_its_exit_code_and_its_sentence(error, code):
    with pytest.raises(VatslocError, match=r"ct\.nrrd is missing; add it") as caught:
        raise error("ct.nrrd is missing; add it.")
    assert caught.value.exit_code == code
