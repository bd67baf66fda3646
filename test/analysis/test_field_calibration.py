"""Field self-calibration against field errors that were put in, and by the command line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mems6dof_ros.analysis.field_calibration import calibrate_field
from mems6dof_ros.analysis.truth import compare
from mems6dof_ros.calibration.field_validation import lateral_errors, learn_field
from mems6dof_ros.calibration.file import Calibration, load_calibration
from mems6dof_ros.cli.main import main
from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.bodies import Bodies
from mems6dof_ros.pose.estimator import PoseEstimator, PoseSettings
from mems6dof_ros.pose.field import FieldError
from mems6dof_ros.pose.synthetic import Scene, SyntheticGear
from mems6dof_ros.recording.tables import CYCLES, read_table
from mems6dof_ros.simulation.settings import SimulationSettings

BAGS = Path(__file__).parents[2] / "bags"
SCENE = Scene(field_error_xy=5e-9, field_error_z=30e-9)


@pytest.fixture(scope="module")
def beads() -> Calibration:
    """A calibration as beads leave it; of its numbers only the size of the field matters here."""
    sample = load_calibration(BAGS / "sample_calibration.yaml")
    return replace(sample, image_size=(2042, 2042), pixel_size=127.34e-9)


def bodies(settings: PoseSettings, field: FieldError) -> Bodies:
    return Bodies([PoseEstimator(settings, field=field)])


def cycles(gear: SyntheticGear, count: int):
    for _ in range(count):
        yield gear.observe()[0]
        gear.advance()


def learnt(beads: Calibration, seed: int, optics: int) -> Calibration:
    found = cycles(SyntheticGear(SCENE, seed, optics=optics), 120)
    return calibrate_field(beads, found, bodies, f"gear {seed}", str(seed)).calibration


def left_over(calibration: Calibration, optics: int) -> tuple[np.ndarray, np.ndarray]:
    """Field error (n, 3) over the field less the correction and what no rotation can tell, and the variance
    (n, 3) that the calibration claims of it."""
    u = np.linspace(-0.9, 0.9, 15) * 130e-6
    place = np.column_stack([*(part.ravel() for part in np.meshgrid(u, u)), np.zeros(u.size**2)])
    true = SyntheticGear(SCENE, 0, optics=optics).field_error(place)
    claimed = np.zeros((len(place), 3))
    if calibration.correction is not None:
        true -= place - calibration.correction.apply(place)
        claimed = np.diagonal(calibration.correction.remaining(place), axis1=1, axis2=2)
    x, y = place[:, 0], place[:, 1]
    one, none = np.ones(len(x)), np.zeros(len(x))
    square = (x**2 + y**2) / 130e-6
    # Shift, rotation and scale; likewise of z, with what depends on the distance to the centre alone.
    plane = np.column_stack([one, x, y, square])
    design = np.concatenate([np.column_stack([one, none, x, -y]), np.column_stack([none, one, y, x])])
    flat = true[:, :2].T.ravel()
    flat = flat - design @ np.linalg.lstsq(design, flat, rcond=None)[0]
    z = true[:, 2] - plane @ np.linalg.lstsq(plane, true[:, 2], rcond=None)[0]
    return np.column_stack([flat[: len(x)], flat[len(x) :], z]), claimed


def test_what_is_left_is_small_and_claimed(beads):
    """About half or less of what was there, and no more than claimed, in the mean variance of four optics,
    which scatters by 1 from one to the next, because a few modes dominate it."""
    ratios = []
    for optics in (1, 2, 3, 4):
        before, _ = left_over(beads, optics)
        after, claimed = left_over(learnt(beads, 10 + optics, optics), optics)
        rms, was = np.sqrt((after**2).mean(axis=0)), np.sqrt((before**2).mean(axis=0))
        assert (rms < 0.55 * was).all(), (rms, was)
        ratios.append([(after[:, part] ** 2).mean() / claimed[:, part].mean() for part in ([0, 1], [2])])
    assert (np.mean(ratios, axis=0) < 2).all(), ratios


def test_the_next_session_begins_with_it(beads):
    """Another gear through the same optics: the first 20 cycles are claimed better, and rightly so."""
    corrected = learnt(beads, 13, 3)
    errors = {}
    for name, calibration in (("before", beads), ("after", corrected)):
        gear = SyntheticGear(SCENE, 77, optics=3)
        settings = PoseSettings(field_size=SCENE.field)
        estimator = PoseEstimator(settings, field=FieldError.remaining(calibration.correction, settings))
        poses, truths = [], []
        for _ in range(20):
            found, truth = gear.observe()
            if calibration.correction is not None:
                found = replace(found, position=calibration.correction.apply(found.position))
            poses.append(estimator.update(found))
            truths.append(truth)
            gear.advance()
        errors[name] = compare(poses, truths)
    assert (errors["after"].claimed_rms < errors["before"].claimed_rms).all()
    assert (errors["after"].rms < errors["before"].rms).all()
    assert 0.5 < errors["after"].nees_per_dof < 1.5


def test_a_second_recording_makes_it_better_and_the_same_one_is_refused(beads):
    once = learnt(beads, 11, 5)
    other = SyntheticGear(SCENE, 12, optics=5)
    found = (replace(f, position=once.correction.apply(f.position)) for f in cycles(other, 120))
    twice = calibrate_field(once, found, bodies, "gear 12", "12")
    assert (twice.after < twice.before).all()
    assert [r["recording"] for r in twice.calibration.correction.provenance["recordings"]] == [
        "gear 11",
        "gear 12",
    ]
    with pytest.raises(InputError, match="second time"):
        calibrate_field(twice.calibration, iter(()), bodies, "gear 11", "11")
    with pytest.raises(InputError, match="no valid pose"):
        calibrate_field(beads, iter(()), bodies, "nothing", "")


def test_rendered_frames_of_another_gear_are_located_better():
    """Reduced `validate calibration`: 512 px, where the distortion is small; the claim holds."""
    sample = load_calibration(BAGS / "sample_calibration.yaml")
    width, height = sample.image_size
    gear = {"width_px": width, "height_px": height, "particles": 24, "clumps": 0, "gear_diameter": 80e-6,
            "hub_diameter": 5e-6}  # fmt: skip
    corrected = learn_field(sample, SimulationSettings(seed=3, **gear), 80)
    held = SimulationSettings(seed=4, brightness_spread=0.0, **gear)
    before, after = (lateral_errors(calibration, held, 20) for calibration in (sample, corrected))
    rms = [float(np.sqrt((errors.error**2).mean())) for errors in (before, after)]
    assert rms[1] < 1.02 * rms[0]
    assert 0.85 < float(np.sqrt(1 / (after.error**2 / after.total).mean())) < 1.3


def test_command(tmp_path, capsys):
    calibration, once, twice = BAGS / "sample_calibration.yaml", tmp_path / "1.yaml", tmp_path / "2.yaml"
    sample = str(BAGS / "sample")
    assert main(["calibrate-field", sample, "--calibration", str(calibration), "--out", str(once)]) == 0
    assert "load_gear, 24 valid poses in 24 cycles" in capsys.readouterr().out
    written = load_calibration(once)
    assert written.correction.provenance["recordings"][0]["recording"] == "sample"
    assert written.with_correction(None).calibration_id == load_calibration(calibration).calibration_id

    assert main(["calibrate-field", sample, "--calibration", str(once), "--out", str(twice)]) == 2
    assert "second time" in capsys.readouterr().err
    assert not twice.exists()

    claimed = []
    for number, file in enumerate((calibration, once)):
        out = tmp_path / f"measured{number}"
        assert main(["analyze", sample, "--calibration", str(file), "--out", str(out)]) == 0
        claimed.append(read_table(out / "cycles.csv", CYCLES)[1]["sd_dx_m"][1:6].mean())
    assert claimed[1] < claimed[0]
