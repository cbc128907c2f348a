"""Scanners as data."""

from __future__ import annotations

import numpy as np
import pytest

from common.errors import UserError
from common.scanner import SCANNERS

TIM571 = SCANNERS["tim571"]


def test_other_beams_look_over_the_same_field_of_view():
    few = TIM571.with_beams(91)
    assert len(few.angles()) == 91
    assert few.angles()[[0, -1]] == pytest.approx(TIM571.angles()[[0, -1]])
    assert np.ptp(few.angles()) == pytest.approx(np.deg2rad(270))
    assert TIM571.with_beams(None) is TIM571


@pytest.mark.parametrize("beams", [-1, 1, 1_000_000])
def test_an_impossible_number_of_beams_is_one_line(beams):
    with pytest.raises(UserError, match=f"tim571 with {beams} beams: beams: Input should be") as error:
        TIM571.with_beams(beams)
    assert "\n" not in str(error.value)
