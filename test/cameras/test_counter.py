from __future__ import annotations

import pytest

from mems6dof_ros.sources.cameras.counter import FrameCounter


@pytest.mark.parametrize(
    ("counts", "steps"),
    [
        ([1, 2, 3], [1, 1, 1]),
        ([0, 1, 5], [1, 1, 4]),  # USB3 Vision begins at 0
        ([65534, 65535, 1, 2], [1, 1, 1, 1]),  # GigE Vision, 16-bit ids without 0
        ([65530, 3], [1, 8]),  # five to 65535, then 1, 2, 3
        ([65534, 65535, 65536, 65540], [1, 1, 1, 4]),  # 64-bit ids
        ([242, 233, 244], [1, 0, 2]),  # an incomplete frame that was given up late
        ([2, 65535, 3], [1, 0, 1]),  # late across the wrap
        ([7, 7, 8], [1, 0, 1]),
    ],
)
def test_steps(counts, steps):
    counter = FrameCounter()
    assert [counter.advance(count) for count in counts] == steps
