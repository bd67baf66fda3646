"""Detection and fits on other people's micrographs: other optics, 8 and 16 bit, debris."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.detection import detect
from mems6dof_ros.localization.fitting import fit_gaussians
from mems6dof_ros.localization.localizations import Flag
from mems6dof_ros.localization.localizer import Localizer, LocalizerSettings

Load = Callable[[str], np.ndarray]


def test_astigmatic_beads_among_dark_debris(real_stack: Load) -> None:
    """Eleven beads: all found within a micrometre of focus, and nothing else trusted in any plane."""
    stack = real_stack("bead_stack_astigmatic_air085.tif")
    camera = CameraNoise(50.0, 0.5, 1.0, 255)
    beads = detect(stack[32])
    assert len(beads) == 11
    localizer = Localizer(camera, None, LocalizerSettings(pixel_size=63.5e-9))
    invented = 0
    for plane, image in enumerate(stack):
        found = localizer.localize(Frame(image, 0, plane, 0))
        good = found.flags & ~np.uint32(Flag.NEIGHBOUR) == Flag.NO_Z  # several beads are neighbours
        distance, _ = cKDTree(beads).query(found.fits.parameters[good, :2])
        invented += int((distance > 12).sum())
        if 27 <= plane <= 38:
            assert good.sum() == 11
            sigma = found.fits.parameters[good, 3:5]
            assert ((sigma > 1.5) & (sigma < 8)).all()
    assert invented == 0


def test_ellipticity_of_real_beads_turns_through_focus(real_stack: Load) -> None:
    stack = real_stack("bead_stack_astigmatic_air085.tif")
    beads, camera = detect(stack[32]), CameraNoise(50.0, 0.5, 1.0, 255)
    ratio = []
    for plane in (27, 38):
        fits = fit_gaussians(stack[plane], beads, camera)
        ratio.append(fits.parameters[:, 3] / fits.parameters[:, 4])
    assert (ratio[0] > 1.3).all()
    assert (ratio[1] < 0.8).all()


def test_crowded_small_beads(real_stack: Load) -> None:
    """200 nm beads at NA 0.95: their centres spread over 2.2 px or less in focus."""
    image = real_stack("bead_stack_plain_na095.tif")[16]
    candidates = detect(image)
    fits = fit_gaussians(image, candidates, CameraNoise(1.0, 0.5, 1.0, 255), window_px=15)
    good = fits.flags & Flag.FIT_FAILED == 0
    assert good.sum() >= 38
    assert np.median(fits.parameters[good, 3:5]) < 2.5


def test_single_bead_in_16_bit(real_stack: Load) -> None:
    """One bead, 300 nm steps, focus at plane 13: found over 5 um, fitted over 2 um."""
    stack = real_stack("bead_intrinsic_air085.tif")
    camera = CameraNoise(100.0, 1.0, 2.0, 65535)
    for image in stack[5:22]:
        assert np.hypot(*(detect(image)[0] - [131.5, 127.5])) < 4
    fits = [fit_gaussians(image, detect(image)[:1], camera) for image in stack[10:17]]
    assert all(found.flags[0] == 0 for found in fits)
    centres = np.array([found.parameters[0, :2] for found in fits])
    assert np.abs(np.diff(centres, axis=0)).max() < 1.0
    sigma = np.array([found.parameters[0, 3:5] for found in fits])
    assert sigma.mean(axis=1).argmin() in (2, 3, 4)
