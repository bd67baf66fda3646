"""One line that renews itself on a terminal, few lines elsewhere."""

from __future__ import annotations

import io

from mems6dof_ros.cli.progress import Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_in_a_log_the_end_is_told():
    stream = io.StringIO()
    with Progress("frames", stream) as progress:
        for done in range(1, 101):
            progress(done, 100, f"pose {done}")
    lines = stream.getvalue().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("frames: 100 of 100, 100%")
    assert lines[0].endswith("pose 100")


def test_on_a_terminal_a_shorter_line_hides_the_longer_one():
    stream = Terminal()
    with Progress("frames", stream) as progress:
        progress(1, 1, "a long remark")
        progress(1, 1)
    first, second = stream.getvalue().strip("\n").split("\r")[1:]
    assert len(second) == len(first)
    assert stream.getvalue().endswith("\n")


def test_nothing_done_tells_nothing():
    stream = Terminal()
    with Progress("frames", stream):
        pass
    assert stream.getvalue() == ""
