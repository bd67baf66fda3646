"""The live page in a real browser: it moves, it is drawn, it steers, and its memory stays flat."""

from __future__ import annotations

import contextlib
import csv
import math
import os
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.monitor.picture import make_picture
from mems6dof_ros.monitor.validation.browser import Console, chromium
from mems6dof_ros.pose.cycle_pose import Status

#: Number of pixels of a canvas that look like ``colour`` (r, g, b).
COUNT_COLOUR = """([selector, colour]) => {
  const { width, height } = document.querySelector(selector);
  const copy = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  copy.drawImage(document.querySelector(selector), 0, 0);
  const { data } = copy.getImageData(0, 0, width, height);
  let count = 0;
  for (let i = 0; i < data.length; i += 4)
    if (colour.every((c, k) => Math.abs(data[i + k] - c) < 40)) count++;
  return count;
}"""
PARTICLE, RESIDUAL = [0x35, 0xD0, 0xFF], [0xFF, 0xE1, 0x4D]


@pytest.fixture(scope="module")
def browser():
    with contextlib.ExitStack() as stack:
        try:
            found = stack.enter_context(chromium("--js-flags=--expose-gc"))
        except Mems6dofError as error:  # says which package or program is missing
            pytest.skip(str(error))
        yield found


@pytest.fixture
def open_page(browser):
    """Open an address in a fresh profile; at the end, the console must have stayed silent."""
    console, pages = Console(), []

    def open_page(url: str, **options):
        pages.append(console.open(browser, url, **options))
        return pages[-1]

    yield open_page
    for page in pages:
        page.context.close()
    assert console.complaints == []


def length(page) -> int:
    return page.evaluate("mems6dof.view.history?.length ?? 0")


def wait_for_cycles(page, count: int) -> None:
    page.wait_for_function("count => (mems6dof.view.history?.length ?? 0) >= count", arg=count, timeout=60000)


def wait_for_text(page, element: str, text: str) -> None:
    page.wait_for_function(
        "([id, text]) => document.getElementById(id).textContent.includes(text)", arg=[element, text]
    )


def picture(page, selector: str) -> bytes:
    return page.evaluate("selector => document.querySelector(selector).toDataURL()", selector)


def test_page_loads_in_two_seconds_and_moves(instrument, open_page):
    times = []
    for _ in range(3):
        started = time.monotonic()
        page = open_page(instrument.url)
        page.wait_for_function("() => mems6dof.charts[0].data?.y.length > 0")
        times.append(time.monotonic() - started)
    # Where others compute on the same machine, everything takes longer by what they leave over.
    crowding = max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
    print(f"loaded and drawn in {min(times):.2f} s, {crowding:.1f} processes per processor")
    assert min(times) < 2.0 * crowding
    wait_for_cycles(page, 100)
    assert page.inner_text("#status-name") in ("TRACKING", "DEGRADED", "LOST")
    for selector in ("[data-quantity=dx] canvas", "[data-quantity=psi] canvas", "#axis-map canvas"):
        before = picture(page, selector)
        page.wait_for_function(
            "([selector, before]) => document.querySelector(selector).toDataURL() !== before",
            arg=[selector, before],
            timeout=30000,
        )
    cycle = int(page.inner_text("#figure-cycle"))
    page.wait_for_function("cycle => +document.getElementById('figure-cycle').textContent > cycle", arg=cycle)
    assert "± " in page.inner_text("[data-quantity=tilt_x] .note")
    assert page.inner_text("[data-quantity=tilt_x] .value").endswith("mrad")
    assert page.inner_text("[data-quantity=dz] .value").endswith("nm")


def test_particles_identities_and_residuals_are_drawn_on_the_micrograph(instrument, open_page):
    page = open_page(instrument.url)
    page.wait_for_function("() => mems6dof.micrograph.overlay?.bodies?.[0] && mems6dof.micrograph.bitmap")
    page.click("#pause")  # one picture to compare with itself
    time.sleep(0.5)
    canvas = "#micrograph-canvas"
    for box, colour in {"#show-particles": PARTICLE, "#show-residuals": RESIDUAL}.items():
        shown = page.evaluate(COUNT_COLOUR, [canvas, colour])
        page.locator(box).evaluate("box => box.click()")
        hidden = page.evaluate(COUNT_COLOUR, [canvas, colour])
        page.locator(box).evaluate("box => box.click()")
        assert shown > 300
        assert hidden < shown / 4
    with_names = picture(page, canvas)
    page.locator("#show-identities").evaluate("box => box.click()")
    assert picture(page, canvas) != with_names
    # A particle tells what is known of it.
    where = page.evaluate(
        """() => {
          const { overlay, canvas } = mems6dof.micrograph, box = canvas.getBoundingClientRect();
          const { scale, left, top } = mems6dof.micrograph.geometry();
          const i = overlay.bodies[0].particle_id.findIndex((id) => id >= 0);
          return [box.left + left + (overlay.x_px[i] + .5) * scale,
            box.top + top + (overlay.y_px[i] + .5) * scale];
        }"""
    )
    page.mouse.move(*where)
    assert page.inner_text("#tooltip").startswith("particle ")
    assert "electrons" in page.inner_text("#tooltip")


def test_buttons_call_the_services(instrument, open_page):
    page = open_page(instrument.url)
    wait_for_cycles(page, 20)
    assert page.is_disabled("[data-service='recorder/stop']")
    page.click("[data-service='frame_source/stop']")
    wait_for_text(page, "answer", "frame_source/stop done")
    wait_for_text(page, "status-name", "STALE")
    page.click("[data-service='frame_source/start']")
    count = length(page)
    wait_for_cycles(page, count + 20)
    assert "frame_source/start" in page.inner_text("#events")


def test_pause_zoom_and_export_of_what_is_shown(instrument, open_page, tmp_path):
    page = open_page(instrument.url)
    wait_for_cycles(page, 120)
    page.click("#pause")
    time.sleep(0.3)
    before, count = picture(page, "[data-quantity=dx] canvas"), length(page)
    wait_for_cycles(page, count + 30)
    assert picture(page, "[data-quantity=dx] canvas") == before
    wait_for_text(page, "pause", "Resume, ")
    page.click("#pause")

    plot = page.locator("[data-quantity=dx] .u-over").bounding_box()
    y = plot["y"] + plot["height"] / 2
    page.mouse.move(plot["x"] + plot["width"] * 0.7, y)
    page.mouse.down()
    page.mouse.move(plot["x"] + plot["width"] * 0.9, y, steps=4)
    page.mouse.up()
    assert page.is_visible("#follow")
    page.wait_for_function("() => mems6dof.view.high - mems6dof.view.low < 100")
    low, high = page.evaluate("[mems6dof.view.low, mems6dof.view.high]")
    assert high - low > 2
    with page.expect_download() as download:
        page.click("#export-csv")
    download.value.save_as(tmp_path / "shown.csv")
    text = (tmp_path / "shown.csv").read_text().splitlines()
    rows = list(csv.DictReader(line for line in text if not line.startswith("#")))
    assert [int(row["cycle"]) for row in rows] == list(range(math.ceil(low), math.floor(high) + 1))
    assert "dx m" in "".join(text[:5])
    values = page.evaluate(
        """() => { const { history, low, high } = mems6dof.view;
        return [...history.columns.psi.slice(...history.range(low, high))]; }"""
    )
    assert [float(row["psi"] or "nan") for row in rows] == pytest.approx(values, rel=0, abs=0, nan_ok=True)

    with page.expect_download() as download:
        page.click("#export-png")
    download.value.save_as(tmp_path / "shown.png")
    image = cv2.imread(str(tmp_path / "shown.png"))
    assert image.shape[1] > 1200
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 100
    page.click("#follow")
    assert not page.is_visible("#follow")


def test_limits_raise_alarms(instrument, open_page):
    page = open_page(instrument.url)
    wait_for_cycles(page, 20)
    page.select_option("#limit-quantity", "dz")
    page.fill("#limit-low", "-0.001")
    page.fill("#limit-high", "0,001")  # nm; a comma will do
    page.click("#limit-form button")
    page.wait_for_selector("#alarm-chip:visible", timeout=30000)
    wait_for_text(page, "limits", "outside")
    assert "dz = " in page.inner_text("#events")
    page.click("#limits button")
    wait_for_text(page, "limits", "No limits set.")


@pytest.mark.parametrize(("scheme", "bright"), [("light", True), ("dark", False)])
def test_the_page_follows_the_colour_scheme_and_can_be_switched(instrument, open_page, scheme, bright):
    page = open_page(instrument.url, color_scheme=scheme)
    background = (
        "getComputedStyle(document.documentElement).backgroundColor.match(/\\d+/g).map(Number)[0] > 128"
    )
    assert page.evaluate(background) is bright
    page.click("#theme")
    assert page.evaluate(background) is not bright
    page.reload()
    assert page.evaluate(background) is not bright


def test_page_comes_back_by_itself(serve, open_page, machine):
    served = serve()
    page = open_page(served.url)
    for number in range(10):
        served.feed.add_pose(machine.cycle(number, image=False)[2])
    wait_for_cycles(page, 10)
    page.evaluate("() => { mems6dof.link.socket.close(); }")
    page.wait_for_selector("#offline:visible")
    page.wait_for_selector("#offline", state="hidden", timeout=30000)
    wait_for_cycles(page, 10)
    assert length(page) == 10  # and nothing twice


def test_memory_stays_flat_however_long_it_runs(serve, open_page, machine):
    """Ten minutes at 90 cycles/s, run through as fast as the page takes them."""
    served = serve()
    frame, found, pose = machine.cycle(0)
    page = open_page(served.url)

    def run_to(first: int, last: int) -> None:
        for number in range(first, last):
            served.feed.add_pose(replace(pose, cycle=number, frame_counter=number))
            if number % 250 == 0:
                served.feed.add_picture(make_picture(frame, found, [pose], served.feed.bodies))
            if number % 500 == 0:  # the server keeps 1000 cycles here; the page must not miss any
                page.wait_for_function("n => mems6dof.view.history?.last('cycle') >= n", arg=number)
        page.wait_for_function("n => mems6dof.view.history.last('cycle') >= n", arg=last - 1)

    def heap() -> float:
        page.evaluate("gc()")
        return page.evaluate("performance.memory.usedJSHeapSize") / 1e6

    run_to(0, 5000)
    early = heap()
    run_to(5000, 54000)
    late = heap()
    print(f"heap {early:.1f} MB after 5000 cycles, {late:.1f} MB after 54000")
    assert length(page) <= 1000
    assert late - early < 1.5


def test_an_empty_page_says_what_is_missing(serve, open_page, machine):
    served = serve()
    page = open_page(served.url)
    served.feed.set_instrument({"rates": {"frame_info": 0.0, "localizations": 0.0, "pose_6dof": 0.0}})
    wait_for_text(page, "status-name", "WAITING")
    wait_for_text(page, "status-reason", "nothing is heard")
    assert page.evaluate("document.querySelector('main').classList.contains('waiting')")
    served.feed.set_instrument({"rates": {"frame_info": 90.0, "localizations": 0.0, "pose_6dof": 0.0}})
    wait_for_text(page, "status-reason", "is localizer running?")
    pose = machine.cycle(0, image=False)[2]
    lost = replace(
        pose, status=Status.LOST, reason="no particles seen", displacement=np.full(6, math.nan), cycle=1
    )
    served.feed.add_pose(lost)
    wait_for_text(page, "status-name", "LOST")
    wait_for_text(page, "status-reason", "no particles seen")
    page.wait_for_selector("[data-quantity=dx] .plot[data-empty^='no valid pose']")
    assert not page.evaluate("document.querySelector('main').classList.contains('waiting')")


def test_the_controller_is_steered_where_there_is_one(serve, open_page, machine):
    served = serve()
    for number in range(20):
        served.feed.add_pose(machine.cycle(number, image=False)[2])
    page = open_page(served.url)
    wait_for_cycles(page, 20)
    assert page.is_hidden("#controller")
    controller = {
        "body": "load_gear",
        "state": "moving",
        "reason": "",
        "target": 0.5,
        "error": -0.0123,
        "cycles": 4,
        "limits": {"max_play": 3e-6, "max_tilt": 5e-3},
    }
    there = {"frame_source/stop": True, "controller/go": True, "controller/stop": True}
    served.feed.set_instrument({"controller": controller, "services": there})
    page.wait_for_selector("#controller", state="visible")
    wait_for_text(page, "controller-state", "MOVING")
    assert page.inner_text("#controller-error") == "\u221212.300 mrad"
    assert page.inner_text("#controller-limits") == "stops beyond play 3 µm, tilt 5 mrad"
    page.wait_for_function("mems6dof.charts.find((c) => c.key === 'psi').target() === 0.5")
    page.fill("#controller-target", "not a number")
    page.click("#controller-go")
    page.fill("#controller-target", "-0,25")
    page.click("#controller-go")
    wait_for_text(page, "answer", "stopped")  # what the test's services answer to everything
    page.select_option("#controller-unit", label="°")
    page.fill("#controller-target", "90")
    page.press("#controller-target", "Enter")
    page.click("#controller-stop")
    page.wait_for_function("() => document.querySelectorAll('#events li:not([hidden])').length >= 4")
    assert served.called == ["controller/go -0.25", f"controller/go {math.pi / 2}", "controller/stop"]
    served.feed.set_instrument({"controller": {**controller, "state": "stopped", "reason": "pose lost"}})
    wait_for_text(page, "controller-state", "STOPPED")
    assert page.inner_text("#controller-reason") == "pose lost"
    served.feed.set_instrument({"services": {"controller/go": False, "controller/stop": False}})
    wait_for_text(page, "controller-state", "NOT THERE")
    assert page.is_disabled("#controller-go")
