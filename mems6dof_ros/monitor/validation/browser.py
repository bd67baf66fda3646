"""Headless Chromium, driven by playwright: what a page shows, complains of and costs.

Both are optional: ``pip install playwright``, and a chromium on the path or ``playwright install chromium``.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp

from mems6dof_ros.errors import Mems6dofError

#: In a page: its plots have been drawn.
READY = "() => mems6dof.charts[0].data?.y.length > 0"


@contextlib.contextmanager
def chromium(*arguments: str) -> Iterator[Any]:
    """A headless browser (of playwright); Mems6dofError where there is none."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ModuleNotFoundError as error:
        raise Mems6dofError("the page is measured by playwright: see docs/monitor.md") from error
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    with sync_playwright() as library:
        usual = ("--no-sandbox", "--disable-gpu", "--disable-background-networking")
        try:
            browser = library.chromium.launch(executable_path=path, args=[*usual, *arguments])
        except Error as error:
            raise Mems6dofError(
                f"no browser: install one of {', '.join(names)}, or run `playwright install chromium`"
            ) from error
        try:
            yield browser
        except Error as error:
            raise Mems6dofError(f"browser: {error.message.splitlines()[0]}") from error
        browser.close()


class Console:
    """Everything that pages complain of."""

    def __init__(self) -> None:
        self.complaints: list[str] = []

    def open(self, browser: Any, url: str, size: tuple[int, int] = (1366, 768), **options: Any) -> Any:
        """A page in a profile of its own."""
        viewport = {"width": size[0], "height": size[1]}
        page = browser.new_context(viewport=viewport, **options).new_page()
        add = self.complaints.append
        page.on("console", lambda m: add(m.text) if m.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: add(str(error)))
        page.on("requestfailed", lambda request: add(request.url))
        page.goto(url)
        return page


def renderers() -> list[int]:
    """Process ids of what draws the pages of this process's browsers."""
    parents: dict[int, int] = {}
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            pid = int(folder.name)
            parents[pid] = int((folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[1])
            if b"--type=renderer" in (folder / "cmdline").read_bytes():
                found.append(pid)

    def ours(pid: int) -> bool:
        while pid > 1:
            if pid == os.getpid():
                return True
            pid = parents.get(pid, 0)
        return False

    return [pid for pid in found if ours(pid)]


def page_socket(session: aiohttp.ClientSession, url: str) -> Any:
    """The connection that a page opens, without a browser."""
    return session.ws_connect(f"{url}live", headers={"Origin": url.rstrip("/")}, max_msg_size=0)
