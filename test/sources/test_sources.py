"""What every source promises, and the table that finds them."""

from __future__ import annotations

import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.sources.source import open_source


def test_unknown_names_are_refused_with_the_choices(tmp_path):
    with pytest.raises(InputError, match=r"'webcam'.*simulator, images, bag"):
        open_source("webcam")
    with pytest.raises(InputError, match=r"option 'stepp'.*path.*step"):
        open_source("images", path=tmp_path, stepp=1e-7)
    with pytest.raises(InputError, match="no option 'path'"):
        open_source("bag")
