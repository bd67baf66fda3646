"""The rows of the validation tables: what they say is required, and their verdicts."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from mems6dof_ros.cli.figures import conclude
from mems6dof_ros.figures import at_least, at_most, between, exactly, figure, information, remark


@pytest.mark.parametrize(
    ("row", "required", "passed"),
    [
        (exactly("n", 0, 0), "0", True),
        (exactly("n", 1, 0), "0", False),
        (at_most("n", 2.4, 2.4), "<= 2.4", True),
        (at_most("n", 2.5, 2.4), "<= 2.4", False),
        (at_most("n", math.nan, 2.4), "<= 2.4", False),
        (at_most("n", 2.5, None), "", None),
        (at_least("n", 20, 20), ">= 20", True),
        (at_least("n", 19, 20), ">= 20", False),
        (between("n", 0.8, 0.8, 1.3), "0.8 to 1.3", True),
        (between("n", 1.31, 0.8, 1.3), "0.8 to 1.3", False),
        (figure("n", 3, "< 10", True), "< 10", True),
        (information("n", 3), "", None),
    ],
)
def test_a_row_says_what_is_required_and_whether_it_is_met(row, required, passed):
    assert (row["required"], row["passed"]) == (required, passed)


def test_numbers_of_numpy_become_plain_ones():
    row = at_most("n", np.float32(0.5), np.float64(1))
    assert row["passed"] is True  # the count of verdicts tells by identity
    assert json.loads(json.dumps(exactly("n", np.int64(3), 3)))["measured"] == 3


def test_a_remark_has_no_number():
    row = remark("not measured: no camera")
    assert row["quantity"] == "not measured: no camera"
    assert math.isnan(row["measured"])
    assert row["passed"] is None


def test_what_was_not_measured_is_not_taken_for_passed(capsys):
    rows = [exactly("n", 1, 1), exactly("m", 1, 2), information("f", 3.0), remark("not measured: no camera")]
    assert conclude(rows, {}, None) == 1
    assert conclude(rows[:1], {}, None) == 0
    assert capsys.readouterr().out.splitlines() == [
        "1 passed, 1 failed, 1 not measured here",
        "1 passed, 0 failed",
    ]
    assert conclude(rows[3:], {}, None) == 1
