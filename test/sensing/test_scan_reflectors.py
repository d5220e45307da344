# SPDX-License-Identifier: Apache-2.0
"""Reflectors are found by themselves in scans of any laser, and walls never become reflectors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.params import Detector, SimulatorParameters, from_mapping
from rlml_slam.sensing.reflectors.reflector_calibration import ReflectorCalibration, calibrated
from rlml_slam.sensing.reflectors.reflector_detector import IntensityCheck
from rlml_slam.sensing.reflectors.scan_reflectors import ScanReflectors
from rlml_slam.simulation.simulation import Simulation
from rlml_slam.simulation.world_file import load_world
from rlml_slam.types import Scan

POSTS = np.array([[3.0, 1.0], [-2.5, 2.0], [1.0, -3.0], [-4.0, -1.5], [6.0, 3.0], [0.5, 4.0]])
STILL = np.zeros(3)


def scan(k, rng, beams=1440, radius=0.04, divergence=0.003, gain=30.0, gloss=0.0):
    """A room of 20 m by 12 m with cylinders, seen from a place that changes with k."""
    at = 0.02 * np.array([k, 0.5 * k])
    angles = np.linspace(-np.pi, np.pi, beams, endpoint=False)
    u = np.stack([np.cos(angles), np.sin(angles)], -1)
    with np.errstate(divide='ignore'):
        sides = np.where(u > 0.0, np.array([10.0, 6.0]) - at, at + np.array([10.0, 6.0])) / np.abs(
            u
        )
    wall = sides.min(axis=1)
    cosine = np.where(sides[:, 0] < sides[:, 1], np.abs(u[:, 0]), np.abs(u[:, 1]))
    ranges, bright = wall.copy(), 200.0 * cosine + gloss * cosine**200
    for post in POSTS - at:
        along, across = u @ post, np.abs(u @ [[0.0, -1.0], [1.0, 0.0]] @ post)
        r = np.hypot(*post)
        lit = (across < radius + 0.5 * divergence * r) & (along > 0.0)
        ranges[lit] = r - radius
        bright[lit] = gain * 200.0
    ranges += rng.normal(0.0, 0.005, beams)
    bright *= 1.0 + rng.normal(0.0, 0.03, beams)
    return Scan(
        k + 1, 'laser', -np.pi, 2.0 * np.pi / beams, 0.0, 0.1, 30.0,
        ranges.astype(np.float32), np.maximum(bright, 0.0).astype(np.float32),
    )  # fmt: skip


def scans(change=lambda bright: bright, count=40, **kind):
    rng = np.random.default_rng(1)
    for k in range(count):
        s = scan(k, rng, **kind)
        yield replace(s, intensities=np.asarray(change(s.intensities), np.float32))


def last_seen(change=lambda bright: bright, mode='auto', **kind):
    """Detections in the newest scan, None if it was not looked at, and what is said of them."""
    reflectors, seen = ScanReflectors(Detector(), mode), None
    for s in scans(change, **kind):
        seen = reflectors.detections(s, STILL, STILL[None])
    return seen, str(reflectors)


def levels(bright):
    """A laser with a few levels of brightness, as SICK's of old: 0 is everything diffuse."""
    return 8192.0 * np.clip(np.floor(np.log2(np.maximum(bright / 500.0, 0.5))), 0.0, 4.0)


@pytest.mark.parametrize(
    ('change', 'kind'),
    [
        (lambda b: b, {}),
        (lambda b: 0.01 * b, {}),
        (lambda b: 1e4 * b, {}),
        (lambda b: np.sqrt(b), {}),
        (levels, {}),
        (levels, {'beams': 721, 'divergence': 0.012}),
        (lambda b: (levels(b) / 8192.0), {'radius': 0.08}),
        (lambda b: b, {'radius': 0.1, 'beams': 2880}),
        (lambda b: np.minimum(b, 254.0 * 6), {'radius': 0.025}),
        (lambda b: np.where(b > 2000.0, 65535.0, b), {}),
    ],
    ids=['as it is', 'dim', 'bright', 'compressed', 'levels', 'wide beams', 'bits', 'large',
         'small', 'marked'],
)  # fmt: skip
def test_reflectors_are_found_on_any_scale(change, kind):
    seen, said = last_seen(change, **kind)
    at = 0.02 * np.array([39.0, 19.5])
    assert seen is not None, said
    off = np.linalg.norm(seen.points[:, None] + at - POSTS, axis=-1)
    # none is anything else; where it looks flat, its surface is its place
    assert (off.min(axis=1) < 0.03 + kind.get('radius', 0.04)).all()
    assert len(set(off.argmin(axis=1))) >= 5  # one may be hidden
    assert 'in a scan' in said


@pytest.mark.parametrize('mode', ['on', 'auto'])
@pytest.mark.parametrize('value', [0.0, 47.0, np.nan])
def test_intensities_that_vanish_are_no_look(mode, value):
    """After good scans: None, not "looked and saw none", which would take reflectors away."""
    reflectors, kept = ScanReflectors(Detector(), mode), []
    for k, s in enumerate(scans()):
        kept.append(reflectors.detections(s, STILL, STILL[None]))
        blind = replace(s, stamp=s.stamp + 1, intensities=np.full_like(s.intensities, value))
        if k > 30:
            assert reflectors.detections(blind, STILL, STILL[None]) is None
    assert len(kept[-1]) > 0
    dark = replace(s, intensities=(0.01 + 1e-4 * np.arange(len(s.ranges)) % 3).astype('f4'))
    found = reflectors.detections(dark, STILL, STILL[None])
    assert found is not None
    assert len(found) == 0


def test_laser_with_levels_has_looked_where_all_is_0():
    reflectors = ScanReflectors(Detector(), 'auto')
    for s in scans(levels):
        reflectors.detections(s, STILL, STILL[None])
    found = reflectors.detections(
        replace(s, intensities=np.zeros_like(s.intensities)), STILL, STILL[None]
    )
    assert found is not None
    assert len(found) == 0


@pytest.mark.parametrize('values', [(0.0, 1.0), (100.0, 255.0), (-5.0, 3.0), (0.0, 3.0, 7.0)])
def test_laser_that_marks_reflectors_has_looked_where_no_beam_is_marked(values):
    check, frames = IntensityCheck(), list(scans())

    def with_values(s, marks):
        bright = np.full(len(s.ranges), values[0], np.float32)
        bright[s.intensities > 2000.0] = values[1] if marks else values[0]
        if marks and len(values) > 2:
            bright[np.flatnonzero(bright > values[0])[:2]] = values[2]
        return replace(s, intensities=bright)

    assert check.fault(with_values(frames[0], False))  # it may as well measure none
    assert not check.fault(with_values(frames[1], True))
    assert not check.fault(with_values(frames[2], False))
    assert check.fault(replace(with_values(frames[3], False), frame_id='other'))
    nothing = np.full_like(frames[4].ranges, np.nan)
    assert check.fault(replace(with_values(frames[4], False), ranges=nothing))
    assert not check.fault(frames[5])  # it has all values
    assert check.fault(with_values(frames[6], False))


def test_an_odd_scan_is_none_of_a_laser_that_marks_reflectors():
    check, (first, *_) = IntensityCheck(), scans()
    half = np.where(np.arange(len(first.ranges)) % 2, 47.0, 0.0).astype('f4')
    two = np.where(np.arange(len(first.ranges)) < 2, first.ranges, np.float32(np.nan))
    check.fault(replace(first, intensities=half))
    check.fault(replace(first, ranges=two))
    assert check.fault(replace(first, intensities=np.zeros_like(first.intensities)))


@pytest.mark.parametrize('gloss', [0.0, 4000.0])
def test_walls_are_no_reflectors(gloss):
    """Neither diffuse ones nor the glare of one that is glossy."""
    seen, said = last_seen(gain=1.0, gloss=gloss)
    assert seen is None or len(seen) == 0, said


def noisy(sigma, seed=3):
    """As a laser whose intensities are little more than a quality of the signal."""
    rng = np.random.default_rng(seed)
    return lambda bright: bright * np.exp(sigma * rng.standard_normal(len(bright)))


@pytest.mark.parametrize('sigma', [0.3, 0.6, 1.0])
def test_noise_of_intensities_is_no_reflector(sigma):
    seen, said = last_seen(noisy(sigma), gain=2.0)
    assert seen is None, said


def test_reflectors_are_found_in_noisy_intensities():
    seen, said = last_seen(noisy(0.4), gain=100.0)
    assert seen is not None, said
    off = np.linalg.norm(seen.points[:, None] + [0.78, 0.39] - POSTS, axis=-1)
    assert off.min(axis=1).max() < 0.1  # all that is seen is a post


def test_reflectors_alone_in_an_open_field_are_found():
    """Nothing else returns: there is nothing to compare them with, and nothing to confuse."""

    def nothing_else(s):
        return replace(s, ranges=np.where(s.intensities > 2000.0, s.ranges, np.inf))

    reflectors, seen = ScanReflectors(Detector(), 'auto'), None
    for s in scans():
        seen = reflectors.detections(nothing_else(s), STILL, STILL[None])
    assert len(seen) >= 5
    assert 'nothing else has an intensity' in str(reflectors)


def test_white_posts_are_no_reflectors():
    seen, said = last_seen(gain=1.8)
    assert seen is None
    assert said == 'nothing stands out of what is diffuse'


def test_without_intensities_nothing_is_looked_at():
    assert last_seen(lambda b: np.zeros(0)) == (None, '')
    assert last_seen(lambda b: np.zeros(len(b)))[0] is None
    assert last_seen(mode='off') == (None, '')


@pytest.mark.parametrize('sigma', [0.005, 0.02, 0.04])
@pytest.mark.parametrize('beams', [720, 1440])
def test_the_noise_of_ranges_is_found(sigma, beams):
    """A laser noisier than the parameter says: its reflectors are not taken for rough things."""
    rng = np.random.default_rng(4)
    more = np.sqrt(max(sigma**2 - 0.005**2, 0.0))  # that of the scans is 5 mm
    noisy = [
        replace(s, ranges=(s.ranges + rng.normal(0.0, more, beams)).astype(np.float32))
        for s in scans(beams=beams)
    ]
    found = calibrated(noisy, Detector())
    assert found.detector.sigma_range == pytest.approx(max(sigma, 0.01), rel=0.15)
    reflectors = ScanReflectors(Detector(), 'auto')
    for s in noisy:
        seen = reflectors.detections(s, STILL, STILL[None])
    assert len(seen) >= 5


def test_scan_without_a_step_between_its_beams_teaches_nothing():
    calibration = ReflectorCalibration(Detector())
    for step in (0.0, np.nan):
        calibration.add(replace(next(scans()), angle_increment=step))
    assert calibration.num_scans == 0


def test_size_and_divergence_are_found():
    found = calibrated(scans(radius=0.1, divergence=0.012, beams=1440), Detector())
    p = found.detector
    assert max(p.diameter, p.flat_width) == pytest.approx(0.2, abs=0.04)
    assert found.detector.divergence == pytest.approx(0.012, abs=0.004)
    assert calibrated(scans(levels), Detector()).ratio == np.inf
    # what explains the spots is left as the parameters have it
    assert calibrated(scans(), Detector()).detector.diameter == Detector().diameter


def test_cylinders_among_flat_reflectors_are_where_they_are():
    """A drive through the hall, whose walls have wider flat ones: no bias along the beams.

    Within five sigmas of the mean of all sightings nearer than 7 m: some 2 mm.
    """
    values = {'world': 'hall', 'duration': 20.0, 'seed': 3}
    simulation = Simulation(load_world('hall'), from_mapping(values, SimulatorParameters))
    true, _ = simulation.true_reflectors()
    T_base_laser = np.array(simulation.parameters.node.laser_pose)
    reflectors, errors = ScanReflectors(Detector(), 'auto'), []
    for event in simulation:
        s = event.message
        if not isinstance(s, Scan):
            continue
        end = min(s.stamp + 10**8, simulation.time)
        here, there = (simulation.truth(t).T_map_base for t in (s.stamp, end))
        seen = reflectors.detections(
            s, T_base_laser, se2.between(here, there)[None], T_odom_base=here
        )  # fmt: skip
        if seen is None:
            continue
        points = se2.transform(se2.inverse(se2.compose(here, T_base_laser)), true)
        for p in points[np.isnan(simulation.world.reflectors.normals)]:
            off, r = seen.points - p, np.hypot(*p)
            errors += [e @ p / r for e in off if np.hypot(*e) < 0.1 and r < 7.0]
    assert len(errors) > 100
    assert abs(np.mean(errors)) < 5.0 * np.std(errors) / np.sqrt(len(errors))
