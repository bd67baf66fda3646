"""Particles in each other's light: two are found where they touch, and either is as good as it claims."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import FIELD

from mems6dof_ros.calibration.psf_neighbours import groups, two_places
from mems6dof_ros.localization.localizations import Flag
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.simulation.microscope import Body, Microscope
from mems6dof_ros.simulation.microsystem import BodyPose, Particles
from mems6dof_ros.sources.simulator import camera_noise

#: Distances of two particles, m; most are found as one spot.
APART = np.array([1.05e-6, 1.1e-6, 1.2e-6, 1.4e-6, 1.6e-6, 1.8e-6])


def pairs() -> np.ndarray:
    """Places (13, 3) m of pairs, each in a direction of its own, and of one particle alone, the last."""
    middle = np.array([(x, y) for y in (-15e-6, 10e-6) for x in (-20e-6, 0.0, 20e-6)])
    angle = np.arange(6) * 1.1
    half = 0.5 * APART[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    place = np.concatenate([middle - half, middle + half, [(10e-6, 24e-6)]])
    height = np.where(np.arange(13) % 2, 0.25e-6, -0.1e-6)
    return np.column_stack([place, height])


def test_pairs_are_two_particles_as_good_as_they_claim(calibrated):
    """6 frames of 6 pairs at 6e4 electrons: all found, none twice; errors in their standard deviations, less
    the mean over frames that local aberrations and the zero of z make, scatter by 1 within a third."""
    settings = replace(FIELD, optics_seed=3, electrons=6e4)
    place = pairs()
    particles = Particles(place, np.full(13, 1e-6), np.full(13, 6e4))
    microscope = Microscope(settings, np.random.default_rng(5))
    localizer = Localizer(camera_noise(settings), calibrated.calibration.with_method("psf"))
    errors, sds = [], []
    for period in range(6):
        pose = BodyPose(np.eye(3), np.zeros(3), 0.0)
        frame = microscope.frame(
            [Body("pairs", particles, particles.electrons, pose)], period=period, cycle=period, stage_z=0.0
        )
        found = localizer.localize(frame)
        assert len(found) == 13
        assert not (found.flags & (Flag.NEIGHBOUR | Flag.POOR_FIT | Flag.NO_Z)).any()
        apart = np.linalg.norm(found.position[:, None, :2] - place[None, :, :2], axis=2)
        index = apart.argmin(axis=0)
        assert len(set(index)) == 13
        assert apart.min(axis=0).max() < 30e-9
        errors.append(found.position[index] - place)
        sds.append(np.sqrt(np.diagonal(found.covariance[index], axis1=1, axis2=2)))
        assert found.fits.flux[index][:12] == pytest.approx(found.fits.flux[index][12], rel=0.2)
    scatter = (errors - np.mean(errors, axis=0)) / np.array(sds) * np.sqrt(6 / 5)
    assert np.sqrt(np.mean(scatter[:, :12] ** 2, axis=(0, 1))) == pytest.approx(1, abs=1 / 3)
    # What a neighbour costs at contact: a third of the precision along the line to it, nothing across.
    lateral = np.sqrt(np.mean(np.square(sds)[:, :, :2], axis=(0, 2)))
    assert lateral[:12].max() < 1.45 * lateral[12]


def test_a_triple_is_three_particles_where_no_gaussian_fits(calibrated):
    """Three in a chain, the middle one faint, of which two are seen and to which no Gaussian is fitted; and a
    pair at the image's edge. 4 frames: all found, within 5 standard deviations and local aberrations."""
    settings = replace(FIELD, optics_seed=3, electrons=6e4)
    chain = np.array([(0.0, 0.0), (1.15e-6, 2.53e-6), (-0.29e-6, 1.81e-6)])
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    edge = 0.5 * settings.height_px * settings.pixel_size - 2.2e-6
    place = np.concatenate([chain - 18e-6, chain @ turn.T + 15e-6, [(5e-6, edge), (6.2e-6, edge)]])
    place = np.column_stack([place, np.tile([0.1e-6, -0.1e-6], 4)])
    light = np.array([8.7e4, 6e4, 3.6e4, 8.7e4, 6e4, 3.6e4, 6e4, 6e4])
    # Others, by which it is known what is usual.
    alone = np.array([(x, y, 0.0) for x in (-10e-6, 5e-6, 22e-6) for y in (-25e-6, -5e-6)])
    particles = Particles(
        np.concatenate([place, alone]), np.full(14, 1e-6), np.concatenate([light, np.full(6, 6e4)])
    )
    microscope = Microscope(settings, np.random.default_rng(6))
    localizer = Localizer(camera_noise(settings), calibrated.calibration.with_method("psf"))
    for period in range(4):
        pose = BodyPose(np.eye(3), np.zeros(3), 0.0)
        body = Body("chain", particles, particles.electrons, pose)
        found = localizer.localize(microscope.frame([body], period=period, cycle=period, stage_z=0.0))
        apart = np.linalg.norm(found.position[:, None, :2] - particles.position[None, :8, :2], axis=2)
        index = np.where(np.isfinite(apart), apart, 1.0).argmin(axis=0)
        assert len(found) == 14
        assert len(set(index)) == 8
        assert apart[index, range(8)].max() < 25e-9
        assert not (found.flags[index] & (Flag.FIT_FAILED | Flag.NEIGHBOUR | Flag.POOR_FIT)).any()
        assert found.fits.flux[index][:6] == pytest.approx(light[:6], rel=0.4)


def test_who_shares_pixels():
    places = np.array([[100.0, 100.0], [120.0, 110.0], [145.0, 100.0], [300.0, 100.0], [np.nan, np.nan]])
    assert [list(group) for group in groups(places, 31)] == [[0, 1, 2]]
    assert groups(places[3:], 31) == []


def test_two_places_are_those_of_two_images():
    axis = np.arange(31) - 15
    unit = np.exp(-0.5 * (axis[:, None] ** 2 + axis**2) / 2.8**2)
    window = np.zeros((67, 67))
    for column, row, light in ((-6, 2, 1000.0), (3, -4, 700.0)):
        window[18 + row : 49 + row, 18 + column : 49 + column] += light * unit
    nobody = np.empty((0, 2))
    found = two_places(window, unit, 6.0, nobody)
    assert found is not None
    assert sorted(map(tuple, found.tolist())) == [(-6.0, 2.0), (3.0, -4.0)]
    assert two_places(-window, unit, 6.0, nobody) is None


def test_two_places_are_those_beside_the_others():
    """A brighter one, known to be there, is not found again."""
    axis = np.arange(31) - 15
    unit = np.exp(-0.5 * (axis[:, None] ** 2 + axis**2) / 2.8**2)
    window = np.zeros((67, 67))
    for column, row, light in ((-6, 2, 1000.0), (3, -4, 700.0), (12, 4, 2000.0)):
        window[18 + row : 49 + row, 18 + column : 49 + column] += light * unit
    found = two_places(window, unit, 6.0, np.array([(12.2, 3.9)]))
    assert found is not None
    assert sorted(map(tuple, found.tolist())) == [(-6.0, 2.0), (3.0, -4.0)]
