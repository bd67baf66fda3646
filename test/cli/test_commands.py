"""The command line: exit status, one line for what is wrong, results where they belong."""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tifffile

from mems6dof_ros import __version__
from mems6dof_ros.analysis.recording import load_recording
from mems6dof_ros.cli.main import COMMANDS, main
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.recording.tables import CYCLES, LOCALIZATIONS, TRUTH, read_table
from mems6dof_ros.sources.source import frames, open_source

ROOT = Path(__file__).parents[2]
SAMPLE, CALIBRATION = ROOT / "bags" / "sample", ROOT / "bags" / "sample_calibration.yaml"
SMALL = ["--width-px", "128", "--height-px", "96"]


def call(capsys, *arguments) -> tuple[int, str, str]:
    status = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def refusal(capsys, *arguments) -> str:
    """The one line on stderr of a command that must fail by the user's input."""
    status, _, err = call(capsys, *arguments)
    assert status == 2
    lines = [line for line in err.strip().splitlines() if not line.startswith("frames:")]
    assert len(lines) == 1, err
    assert lines[0].startswith("mems6dof: ")
    return lines[0]


def test_version_and_help(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["--version"])
    assert caught.value.code == 0
    assert __version__ in capsys.readouterr().out
    with pytest.raises(SystemExit) as caught:
        main(["--help"])
    assert caught.value.code == 0
    text = capsys.readouterr().out
    for command in COMMANDS:
        assert command in text


def test_help_of_every_command(capsys):
    names = []
    for name, target in COMMANDS.items():
        names += [[name]] if isinstance(target, str) else [[name, sub] for sub in target]
    for name in names:
        with pytest.raises(SystemExit) as caught:
            main([*name, "--help"])
        assert caught.value.code == 0
        assert "usage: mems6dof" in capsys.readouterr().out


def test_a_command_does_not_load_what_it_does_not_need():
    code = (
        "import sys; from mems6dof_ros.cli.main import build_parser; build_parser(['report']);"
        "print([m for m in ('numba', 'matplotlib', 'scipy', 'cv2', 'rosbags') if m in sys.modules])"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert loaded.stdout.strip() == "[]"


def test_simulate_a_bag(capsys, tmp_path):
    status, out, _ = call(capsys, "simulate", "--out", tmp_path / "run", "--cycles", 3, "--seed", 4, *SMALL)
    assert (status, out.strip()) == (0, str(tmp_path / "run"))
    source = open_source("bag", path=tmp_path / "run")
    assert (source.info.width, source.info.height, source.info.frames) == (128, 96, 3)
    assert float(np.mean(source.info.camera.gain_adu_per_electron)) == 2.0
    expected = open_source("simulator", cycles=3, seed=4, width_px=128, height_px=96)
    for frame, again in zip(frames(source), frames(expected), strict=True):
        assert np.array_equal(frame.image, again.image)
        assert frame.truth[0].psi == again.truth[0].psi
    with BagReader(tmp_path / "run") as bag:
        assert json.loads(bag.provenance()["simulation"])["seed"] == 4


def test_simulate_a_tiff_stack_through_focus(capsys, tmp_path):
    options = ("--format", "tiff", "--focus-stack", "1e-6", "5e-7", "--beads", 3, *SMALL)
    status, _, _ = call(capsys, "simulate", "--out", tmp_path / "stack", *options)
    assert status == 0
    assert tifffile.imread(tmp_path / "stack" / "frames.tif").shape == (5, 96, 128)
    provenance, truth = read_table(tmp_path / "stack" / "truth.csv", TRUTH)
    assert json.loads(provenance["simulation"])["width_px"] == 128
    np.testing.assert_allclose(truth["z_m"], [1e-6, 5e-7, 0, -5e-7, -1e-6], atol=1e-12)


def test_analyze_and_report(capsys, tmp_path):
    out = tmp_path / "results"
    status, text, _ = call(capsys, "analyze", SAMPLE, "--calibration", CALIBRATION, "--out", out)
    assert status == 0
    assert "poses: tracking 24" in text
    assert re.search(r"dx +\d\.\d+ +\d\.\d+ nm", text)
    provenance, cycles = read_table(out / "cycles.csv", CYCLES)
    assert len(cycles["cycle"]) == 24
    assert provenance["input"] == "sample"
    assert re.fullmatch("[0-9a-f]{64}", provenance["input_sha256"])
    with BagReader(out / "bag") as bag:
        assert bag.attachments()["calibration.yaml"] == CALIBRATION.read_bytes()
    status, text, _ = call(capsys, "report", out / "bag")
    assert status == 0
    assert Path(text.strip()) == out / "bag_report" / "report.html"
    assert Path(text.strip()).exists()


def test_analyze_images_in_two_dimensions(capsys, tmp_path):
    stack = np.stack([frame.image for frame in itertools.islice(frames(open_source("bag", path=SAMPLE)), 5)])
    tifffile.imwrite(tmp_path / "stack.tif", stack)
    base = ("analyze", tmp_path / "stack.tif", "--calibration", "none", "--out", tmp_path / "out")
    assert "--offset, --gain, --read-noise" in refusal(capsys, *base, "--pixel-size", "127.34e-9")
    camera = ("--offset", 100, "--gain", 2, "--read-noise", 1.7)
    assert "no pixel size" in refusal(capsys, *base, *camera)
    status, text, _ = call(capsys, *base, *camera, "--pixel-size", "127.34e-9")
    assert (status, "frames 5" in text) == (0, True)
    _, particles = read_table(tmp_path / "out" / "localizations.csv", LOCALIZATIONS)
    assert len(particles["x_m"]) > 30


def test_input_that_cannot_be_used_is_one_line(capsys, tmp_path):
    out = ("--out", tmp_path / "out")
    use = ("--calibration", CALIBRATION, *out)
    assert "absent" in refusal(capsys, "analyze", tmp_path / "absent.tif", *use)

    def refused_calibration(name: str, text: str | None) -> None:
        if text is not None:
            (tmp_path / name).write_text(text)
        assert name in refusal(capsys, "analyze", SAMPLE, "--calibration", tmp_path / name, *out)

    text = CALIBRATION.read_text()
    refused_calibration("absent.yaml", None)
    refused_calibration(
        "nan.yaml", re.sub("gain_adu_per_electron: [0-9.]+", "gain_adu_per_electron: .nan", text)
    )
    refused_calibration("cut.yaml", text[: len(text) // 2])
    refused_calibration("changed.yaml", re.sub("pixel_size_m: [0-9.e-]+", "pixel_size_m: 1.3e-07", text))
    refused_calibration("other.yaml", "format: something else")

    main(["simulate", "--out", str(tmp_path / "small"), "--cycles", "1", *SMALL])
    assert "384 x 384 px of calibration" in refusal(capsys, "analyze", tmp_path / "small", *use)
    tifffile.imwrite(tmp_path / "rgb.tif", np.zeros((2, 384, 384, 3), np.uint8), photometric="rgb")
    assert "colour" in refusal(capsys, "analyze", tmp_path / "rgb.tif", *use)

    shutil.copytree(SAMPLE, tmp_path / "bag")
    file = next((tmp_path / "bag").glob("*.mcap"))
    os.truncate(file, file.stat().st_size // 2)
    assert "readable bag" in refusal(capsys, "analyze", tmp_path / "bag", *use)
    assert "readable bag" in refusal(capsys, "report", tmp_path / "bag")
    assert "no poses" in refusal(capsys, "report", SAMPLE)

    assert "positive range" in refusal(capsys, "simulate", *out, "--focus-stack", "1e-6", "nan")
    assert "electrons" in refusal(capsys, "simulate", *out, "--electrons", "nan")
    assert "--cycles" in refusal(capsys, "simulate", *out, "--cycles", "0")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_work_is_complete_so_far(tmp_path, number):
    out = tmp_path / "out"
    command = [
        sys.executable,
        "-m",
        "mems6dof_ros.cli.main",
        "simulate",
        "--out",
        str(out),
        "--cycles",
        "100000",
        *SMALL,
    ]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 60
    file = out / "out_0.mcap"
    while not (file.exists() and file.stat().st_size > 300_000) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(number)
    process.communicate(timeout=60)
    assert process.returncode == 130
    with BagReader(out) as bag:
        counts = bag.counts
    assert counts["/image_raw"] == counts["/truth"] == counts["/frame_info"] > 3


def test_nothing_is_lost_of_a_broken_pipe():
    command = f"{sys.executable} -m mems6dof_ros.cli.main simulate --help | head -1"
    done = subprocess.run(["bash", "-c", command], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.startswith("usage")
    assert "Traceback" not in done.stderr


def test_the_recorded_poses_are_found_whatever_the_namespace(capsys, tmp_path):
    from mems6dof_ros.recording.bag import BagWriter

    out = tmp_path / "results"
    call(capsys, "analyze", SAMPLE, "--calibration", CALIBRATION, "--out", out)
    with BagReader(out / "bag") as reader, BagWriter(tmp_path / "live") as writer:
        for topic, kind, when, message in reader.messages():
            data = reader._reader.typestore.serialize_cdr(message, kind)
            writer.write(writer.add_channel(f"/left{topic}", kind), data, when)
    assert len(load_recording(tmp_path / "live").poses["load_gear"]) == 24


def test_check_and_recover(capsys, tmp_path):
    assert call(capsys, "check", SAMPLE)[0] == 0
    shutil.copytree(SAMPLE, tmp_path / "bag")
    file = next((tmp_path / "bag").glob("*.mcap"))
    os.truncate(file, file.stat().st_size // 2)
    assert "'mems6dof recover' completes" in refusal(capsys, "check", tmp_path / "bag")
    status, text, _ = call(capsys, "recover", tmp_path / "bag")
    assert status == 0
    assert re.search(r"\d+ messages, completed, \d+ bytes could not be read", text)
    status, text, _ = call(capsys, "check", tmp_path / "bag")
    assert (status, text.splitlines()[-1]) == (0, "whole")
    assert len(list(frames(open_source("bag", path=tmp_path / "bag")))) > 8


@pytest.mark.parametrize(
    ("name", "pixel_size", "step", "beads", "planes"),
    [
        ("bead_stack_astigmatic_air085.tif", 63.5e-9, 1e-7, 6, slice(30, 36)),
        ("bead_stack_plain_na095.tif", 108.33e-9, 3e-7, 20, slice(17, 20)),
        ("bead_intrinsic_air085.tif", 130e-9, 3e-7, 1, slice(6, 10)),
    ],
)
def test_real_micrographs(capsys, tmp_path, name, pixel_size, step, beads, planes):
    """Beads near focus are found in every plane, and fitted with widths that such optics give."""
    folder = Path(os.environ.get("MEMS6DOF_REAL_DATA", ROOT.parent / "shared" / "data"))
    if not (folder / name).exists():
        pytest.skip("no real micrographs here (MEMS6DOF_REAL_DATA)")
    camera = ("--offset", 0, "--gain", 1, "--read-noise", 1)
    scale = ("--pixel-size", pixel_size, "--step", step, "--calibration", "none")
    assert call(capsys, "analyze", folder / name, "--out", tmp_path / "out", *scale, *camera)[0] == 0
    _, found = read_table(tmp_path / "out" / "localizations.csv", LOCALIZATIONS)
    near = (found["flags"] & ~512 == 0) & (found["cycle"] >= planes.start) & (found["cycle"] < planes.stop)
    counts = np.bincount(found["cycle"][near], minlength=planes.stop)[planes]
    assert (counts >= beads).all()
    width = np.hypot(found["sigma_x_px"], found["sigma_y_px"])[near] * pixel_size
    assert 0.15e-6 < np.median(width) < 2e-6
