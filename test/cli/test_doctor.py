# SPDX-License-Identifier: Apache-2.0
"""rlml doctor: what it sees in a bag, and that its proposal works."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rlml_lab.studies.detector_scenes import StillLaser, cylinders
from rlml_slam.cli.main import main
from rlml_slam.params import Detector, Laser
from rlml_slam.ros.bags.bag import BagWriter
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.sensing.reflectors.reflector_detector import detect

R2000 = Path(__file__).resolve().parents[3] / 'shared' / 'data' / 'reflector-r2000'


@pytest.fixture(scope='module')
def scans():
    """Of 12 cylinders at each of three distances."""
    rng, still = np.random.default_rng(4), StillLaser(Laser(), 4)
    distances = [2.0, 5.0, 10.0] * 10
    made = [still.scan(cylinders(rng, 0.08, d)[0]) for d in distances]
    return [replace(s, stamp=(k + 1) * 10**8) for k, s in enumerate(made)]


def write(path, scans):
    with BagWriter(path) as bag:
        bag.add_topic('/scan', 'sensor_msgs/msg/LaserScan')
        for scan in scans:
            bag.write('/scan', encode.laser_scan(make_bag, scan), scan.stamp)
    return str(path)


def examined(capsys, *args):
    assert main(['doctor', *args, '--json']) == 0
    return json.loads(capsys.readouterr().out)


def test_the_proposed_curve_finds_what_the_automatic_threshold_does(scans, tmp_path, capsys):
    figures = examined(capsys, write(tmp_path / 'bag', scans))
    assert figures['scans'] == 30
    assert figures['reflectors_mean'] > 11.5
    proposed = figures['proposed']
    assert proposed.pop('detector.threshold') == 'curve'
    p = Detector(threshold='curve', **{k.split('.')[1]: v for k, v in proposed.items()})
    for scan in scans:
        assert len(detect(scan, p)) == len(detect(scan, Detector()))


def test_it_says_what_it_sees_and_draws_it(scans, tmp_path, capsys):
    png = tmp_path / 'seen.png'
    assert main(['doctor', write(tmp_path / 'bag', scans), '--out', str(png)]) == 0
    said = capsys.readouterr().out
    assert 'reflectors are seen per scan' in said
    assert 'mm wide' in said
    assert 'detector.threshold: curve' in said
    assert png.read_bytes().startswith(b'\x89PNG')


def test_scans_without_intensities_are_told(scans, tmp_path, capsys):
    none = np.zeros(0, np.float32)
    bag = write(tmp_path / 'bag', [replace(s, intensities=none) for s in scans[:3]])
    assert main(['doctor', bag]) == 0
    assert 'no intensities' in capsys.readouterr().out


def test_the_vendors_mark_is_recognised(scans, tmp_path, capsys):
    marked = [
        replace(s, intensities=np.where(s.intensities > 3000, 65535, 200).astype(np.float32))
        for s in scans[:3]
    ]
    figures = examined(capsys, write(tmp_path / 'bag', marked))
    assert figures['proposed'] == {'detector.threshold': 'bit'}


def test_intensities_that_are_cut_off_are_no_mark(scans, tmp_path, capsys):
    """Of a few beams near reflectors; most reflectors are less bright than that."""
    most = max(float(s.intensities.max()) for s in scans[:10])
    scaled = [
        replace(s, intensities=np.minimum(s.intensities * (80000.0 / most), 65535.0))
        for s in scans[:10]
    ]
    assert max(s.intensities.max() for s in scaled) == 65535.0
    figures = examined(capsys, write(tmp_path / 'bag', scaled))
    assert figures['proposed']['detector.threshold'] == 'curve'


def test_a_bag_without_reflectors_gets_no_proposal(scans, tmp_path, capsys):
    plain = [replace(s, intensities=np.minimum(s.intensities, 500)) for s in scans[:3]]
    figures = examined(capsys, write(tmp_path / 'bag', plain))
    assert figures['reflectors_max'] == 0
    assert 'proposed' not in figures


def test_scans_of_no_geometry_are_left_out(scans, tmp_path, capsys):
    odd = [replace(s, angle_increment=0.0) for s in scans[:2]]
    assert examined(capsys, write(tmp_path / 'bag', [*odd, *scans[2:]]))['scans'] == 28
    assert main(['doctor', write(tmp_path / 'none', odd)]) == 1
    said = capsys.readouterr().err
    assert 'no scan that can be used: angle_increment is 0' in said


def test_beams_without_a_number_for_intensity_are_left_out(scans, tmp_path, capsys):
    holes = [replace(s, intensities=s.intensities.copy()) for s in scans[:10]]
    for scan in holes:
        scan.intensities[::7] = np.nan
    assert main(['doctor', write(tmp_path / 'bag', holes), '--json']) == 0
    text = capsys.readouterr().out
    assert 'NaN' not in text
    assert json.loads(text)['intensity_max'] > 0.0


def test_a_bag_without_scans_is_one_line(tmp_path, capsys):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('/odom', 'nav_msgs/msg/Odometry')
    assert main(['doctor', str(tmp_path / 'bag')]) == 1
    assert 'no scan' in capsys.readouterr().err


@pytest.mark.skipif(not R2000.exists(), reason='needs ../shared/data/reflector-r2000')
def test_the_recorded_reflectors_are_described(capsys):
    figures = examined(capsys, str(R2000 / 'r2000_locate0.bag'))
    assert figures['scans'] == 38
    assert figures['reflectors_min'] == figures['reflectors_max'] == 8
    assert figures['width_median_m'] == pytest.approx(0.06, abs=0.005)
    assert figures['margin'] > 4.0
