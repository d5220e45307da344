# SPDX-License-Identifier: Apache-2.0
"""A wall that the submap saw from its other side only holds no match."""

import numpy as np
import pytest
from made_scans import end_points

from rlml_slam import se2
from rlml_slam.matching.scans import scan_information
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.matching.scans.wall_sides import least_share, of_seen_sides
from rlml_slam.params import ScanMatch
from rlml_slam.params import Submap as SubmapParameters

WIDTH = 2.4  # [m] of both corridors
# along x from -15 to 15, crossed by one from x = 0 to x = WIDTH
CROSSING = (
    *((a, y, b, y) for y in (0.0, WIDTH) for a, b in ((-15.0, 0.0), (WIDTH, 15.0))),
    *((x, a, x, b) for x in (0.0, WIDTH) for a, b in ((-8.0, 0.0), (WIDTH, WIDTH + 8.0))),
)  # fmt: skip
VIEW = np.radians(np.arange(-90.0, 90.5, 1.0))
AROUND = np.radians(np.arange(-180.0, 180.0, 1.0))
ORIGIN = np.array([0.1, 0.0])  # of the laser in base
BACK = np.array([6.0, 0.5 * WIDTH, np.pi])


def scan(pose, view=VIEW):
    """End points (n, 2) in base, of a laser that looks ahead, or around."""
    return end_points(pose, CROSSING, view, 20.0, ORIGIN)


def mapped(heading=0.0, resolution=0.05, view=VIEW):
    """Submap of a drive through the crossing with one heading."""
    submap = Submap(SubmapParameters(resolution=resolution))
    for x in np.arange(-6.0, 6.0, 0.4):
        pose = np.array([x, 0.5 * WIDTH, heading])
        at = se2.transform(pose, np.vstack([scan(pose, view), ORIGIN]))
        submap.insert(at[:-1], at[-1])
    return submap


def share(submap, true, pose, view=VIEW):
    """Least share of seen sides in the information at ``pose`` of a scan from ``true``."""
    points = scan(true, view)
    facing = points[of_seen_sides(submap, points, ORIGIN, pose)]
    whole, part = (
        scan_information.information(submap, p, pose, ScanMatch()) for p in (points, facing)
    )
    return least_share(part, whole)


@pytest.mark.parametrize('view', [VIEW, AROUND], ids=['ahead', 'around'])
@pytest.mark.parametrize('resolution', [0.025, 0.05, 0.1, 0.2])
@pytest.mark.parametrize('x', [-5.0, -2.5, -1.0])
@pytest.mark.parametrize('aside', [-0.6, 0.0, 0.6])
def test_scan_of_the_same_direction_is_of_seen_sides(x, aside, resolution, view):
    pose = np.array([x, 0.5 * WIDTH + aside, 0.1])
    assert share(mapped(resolution=resolution, view=view), pose, pose, view) > 0.6


@pytest.mark.parametrize('resolution', [0.025, 0.05, 0.1, 0.2])
def test_walls_across_are_not_those_of_the_way_there(resolution):
    """Displaced by the width of the crossing, the scan of the way back fits, and is found out."""
    displaced = BACK + np.array([WIDTH, 0.0, 0.0])
    assert share(mapped(resolution=resolution), BACK, displaced) < 0.05


def test_submap_of_the_way_back_has_seen_them():
    assert share(mapped(heading=np.pi), BACK, BACK) > 0.6


def test_nothing_is_known_of_an_empty_submap_or_scan():
    assert not of_seen_sides(Submap(), scan(BACK), ORIGIN, BACK).any()
    assert of_seen_sides(mapped(), np.zeros((0, 2)), ORIGIN, BACK).shape == (0,)


def test_least_share_is_that_of_the_weakest_direction():
    whole = np.diag([100.0, 400.0, 50.0])
    assert least_share(whole, whole) == pytest.approx(1.0)
    assert least_share(np.diag([100.0, 40.0, 50.0]), whole) == pytest.approx(0.1, rel=1e-3)
    assert least_share(np.zeros((3, 3)), whole) < 1e-3
    # turned, and with a heading that depends on the position
    R = se2.rotation3(0.7)
    assert least_share(R @ np.diag([100.0, 40.0, 50.0]) @ R.T, R @ whole @ R.T) == pytest.approx(
        0.1, rel=1e-3
    )
    tied = whole + 20.0 * (np.eye(3)[[2, 1, 0]] * [1.0, 0.0, 1.0])
    assert 0.0 < least_share(0.5 * tied, tied) == pytest.approx(0.5, rel=1e-3)
