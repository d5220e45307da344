# SPDX-License-Identifier: Apache-2.0
"""The audit of a layout: what is wrong is named, what is right is not; the record is bounded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning import site as sites
from rlml_slam.planning import site_file
from rlml_slam.planning.audit import sightings as record
from rlml_slam.planning.audit.audit import Audit, in_frame_of, make_audit
from rlml_slam.planning.audit.displacement import displacement
from rlml_slam.planning.audit.evidence import gather
from rlml_slam.planning.audit.findings import Finding, Kind, ranked
from rlml_slam.planning.audit.sightings import SightingLog, Sightings
from rlml_slam.planning.site import Site
from rlml_slam.planning.visibility import visible
from rlml_slam.report import audit_page
from rlml_slam.se2 import Array
from rlml_slam.sensing.polar import polar_covariance
from rlml_slam.simulation.world_file import load_world
from rlml_slam.types import Detections, Frame, Health, Level, Motion, Observation

P, SENSOR = Parameters(), SimulatorParameters()
WORLD = load_world('symmetric')
SITE = sites.of_world(WORLD)
PLAN = {'area_size_m': 5.0, 'areas': [
    {'area': f'{chr(65 + j)}{i}', 'x_m': -10.0 + 5.0 * j, 'y_m': -7.5 + 5.0 * i}
    for j in range(4) for i in range(3)]}  # fmt: skip


def path() -> Array:
    """Poses every 0.1 m along the route."""
    legs = []
    for a, b in zip(WORLD.route[:-1], WORLD.route[1:], strict=True):
        share = np.arange(0.0, 1.0, 0.1 / np.hypot(*(b - a)))[:, None]
        turn = np.arctan2(*(b - a)[::-1])
        legs.append(np.hstack([a + share * (b - a), np.full((len(share), 1), turn)]))
    return np.concatenate(legs)


def sightings(
    seed: int = 0, true: Site = SITE, rate: Array | float = 0.98, pose_error: float = 0.01,
    more: Array | None = None, missed: Array | None = None,
) -> Sightings:  # fmt: skip
    """What a robot in the true layout saw; ``more`` (g, 2): seen from everywhere within 12 m."""
    rng, poses = np.random.default_rng(seed), path()
    seen = visible(true, poses[:, :2], P, SENSOR)
    seen &= rng.random(seen.shape) < rate
    if missed is not None:
        seen &= ~missed
    points = true.reflectors.points
    if more is not None:
        points = np.concatenate([points, more])
        near = np.hypot(*(more - poses[:, None, :2]).transpose(2, 0, 1)) < 12.0
        seen = np.hstack([seen, near])
    scan, k = np.nonzero(seen)
    z = se2.transform(se2.inverse(poses)[scan], points[k, None])[:, 0]
    r = np.hypot(*z.T)
    cov = polar_covariance(z / r[:, None], P.reflector.sigma_range**2,
                           (r * P.reflector.sigma_bearing) ** 2)  # fmt: skip
    noise = np.einsum('kij,kj->ki', np.linalg.cholesky(cov), rng.standard_normal(z.shape))
    n = len(poses)
    believed = poses + pose_error * rng.standard_normal((n, 3)) * [1.0, 1.0, 0.2]
    return Sightings(
        np.arange(n) * 10**8, believed, np.tile(1e-4 * np.eye(3), (n, 1, 1)), np.zeros(n, int),
        np.zeros(n, int), np.array(['', record.OTHER]), np.zeros(2), scan, z + noise, cov,
    )  # fmt: skip


def audit(s: Sightings, site: Site = SITE) -> Audit:
    return make_audit(site, s, PLAN, P, SENSOR, 0.005)


def shifted(k: int, by: tuple[float, float]) -> Site:
    points = SITE.reflectors.points.copy()
    points[k] += by
    return replace(SITE, reflectors=replace(SITE.reflectors, points=points))


@pytest.mark.parametrize('seed', range(5))
def test_sound_layout_has_no_findings(seed):
    found = audit(sightings(seed))
    assert not found.findings, [f.what for f in found.findings]
    assert found.figures['usual_rate'] == pytest.approx(0.98, abs=0.02)


@pytest.mark.parametrize('seed', range(3))
def test_moved_reflector_is_named_with_its_displacement(seed):
    found = audit(sightings(seed, shifted(3, (0.04, -0.03)))).findings
    assert [(f.kind, f.subject) for f in found] == [(Kind.MOVED, 3)]
    np.testing.assert_allclose(found[0].shift, (0.04, -0.03), atol=0.01)


def test_reflector_that_was_moved_far_is_no_ghost():
    found = audit(sightings(1, shifted(3, (-0.8, 0.5)))).findings
    assert [(f.kind, f.subject) for f in found] == [(Kind.MOVED, 3)]
    np.testing.assert_allclose(found[0].shift, (-0.8, 0.5), atol=0.05)


def test_hidden_and_dirty_reflectors_are_distinguished():
    rate = np.full(len(SITE.reflectors), 0.98)
    rate[2], rate[6] = 0.0, 0.5
    found = audit(sightings(2, rate=rate)).findings
    assert [(f.kind, f.subject) for f in found] == [(Kind.HIDDEN, 2), (Kind.DIRTY, 6)]


def test_reflector_hidden_from_one_side_is_not_dirty():
    d = path()[:, :2] - SITE.reflectors.points[6]
    missed = np.zeros((len(d), len(SITE.reflectors)), dtype=bool)
    u = d.mean(axis=0)
    missed[:, 6] = d @ [-u[1], u[0]] > 0.0  # on the left of the middle
    found = audit(sightings(3, missed=missed)).findings
    assert [(f.kind, f.subject) for f in found] == [(Kind.TURNED, 6)]


def test_people_who_pass_are_no_fault():
    """Misses in rows of ten scans, everywhere: the usual rate is low, and no one stands out."""
    rng = np.random.default_rng(4)
    missed = np.repeat(rng.random((80, len(SITE.reflectors))) < 0.15, 10, axis=0)[: len(path())]
    found = audit(sightings(4, missed=missed))
    assert found.figures['dispersion'] > 2.0
    assert not found.findings


def test_mirror_image_names_the_wall():
    wall = SITE.walls.segments[0, :4].reshape(2, 2)
    u = (wall[1] - wall[0]) / np.hypot(*(wall[1] - wall[0]))
    v = np.array([-u[1], u[0]])
    gaps = np.abs((SITE.reflectors.points - wall[0]) @ v)
    k = int(np.argsort(gaps)[len(gaps) // 2])
    image = SITE.reflectors.points[k] - 2.0 * ((SITE.reflectors.points[k] - wall[0]) @ v) * v
    found = audit(sightings(5, more=image[None])).findings
    assert [(f.kind, f.subject) for f in found] == [(Kind.MIRROR, k)]
    assert (np.abs((found[0].wall - wall[0]) @ v) < 0.1).all()


def test_ghost_without_a_mirror_has_a_place():
    found = audit(sightings(6, more=np.array([[0.4, 1.3]]))).findings
    assert [f.kind for f in found] == [Kind.GHOST]
    assert np.hypot(found[0].x - 0.4, found[0].y - 1.3) < 0.05


def test_scattered_ghosts_are_no_finding():
    rng = np.random.default_rng(7)
    s = sightings(7)
    extra = rng.integers(len(s.stamps), size=40)
    s = replace(s, scan=np.append(s.scan, extra), cov=np.concatenate([s.cov, s.cov[:40]]),
                points=np.concatenate([s.points, rng.uniform(-8.0, 8.0, (40, 2))]))  # fmt: skip
    assert not audit(s).findings


def test_spells_of_bad_health_name_area_and_reason():
    s = sightings(8)
    bad = (s.poses[:, 0] < -5.0) & (s.poses[:, 1] < -2.5)
    s = replace(s, levels=bad.astype(int), texts=np.array(['', 'wheels slip', record.OTHER]),
                reasons=bad.astype(int))  # fmt: skip
    found = audit(s).findings
    assert [f.kind for f in found] == [Kind.DEGRADED]
    assert 'wheels slip' in found[0].what
    assert 'A0: DEGRADED in' in found[0].what
    assert 'enough: see to the reason' in found[0].advice  # more reflectors do not help wheels
    few = replace(SITE.reflectors, **{k: v[:2] for k, v in vars(SITE.reflectors).items()})
    site = replace(SITE, reflectors=few, cov=SITE.cov[:2])
    s = replace(sightings(8, site), levels=s.levels, texts=s.texts, reasons=s.reasons)
    found = audit(s, site).findings
    (degraded,) = (f for f in found if f.kind is Kind.DEGRADED)
    assert degraded.advice.endswith('see rlml plan --suggest')


def test_robot_that_was_lost_is_a_finding_where_it_last_knew_its_place():
    s = sightings(8)
    n = len(s.levels)
    levels, reasons = np.zeros(n, dtype=int), np.zeros(n, dtype=int)
    levels[:30] = 2  # not yet located, at the start
    assert not audit(replace(s, levels=levels)).findings
    levels[100:150] = levels[200:205] = 2
    reasons[100:150] = 1
    s = replace(s, levels=levels, reasons=reasons,
                texts=np.array(['', 'nothing fits', record.OTHER]))  # fmt: skip
    found = audit(s).findings
    assert [f.kind for f in found] == [Kind.LOST]
    assert found[0].what.startswith(f'LOST in 55 of {n} scans, 2 times, longest after (')
    assert found[0].what.endswith('nothing fits')
    np.testing.assert_allclose((found[0].x, found[0].y), s.poses[99, :2])


def test_map_of_an_audit_shows_what_the_layout_has_not(monkeypatch):
    drawn = []
    monkeypatch.setattr(audit_page.draw, 'png', lambda figure: drawn.append(figure) or b'')
    s = sightings(6, more=np.array([[0.4, 1.3]]))
    audit_page.picture_of(audit(replace(s, levels=(s.poses[:, 0] < -5.0).astype(int))))
    labels = [line.get_label() for line in drawn[0].axes[0].lines]
    assert labels[:4] == ['OK', 'DEGRADED', 'not in the layout', 'layout']


def test_findings_are_ranked_each_with_what_to_do():
    """By kind in the order of Kind, and of one kind by how often it was due."""
    rate = np.full(len(SITE.reflectors), 0.98)
    rate[2], rate[6], rate[7] = 0.0, 0.5, 0.5
    s = sightings(8, shifted(3, (0.04, -0.03)), rate=rate, more=np.array([[0.4, 1.3]]))
    bad = (s.poses[:, 0] < -5.0) & (s.poses[:, 1] < -2.5)
    s = replace(s, levels=bad.astype(int), texts=np.array(['', 'wheels slip', record.OTHER]),
                reasons=bad.astype(int))  # fmt: skip
    found = audit(s).findings
    assert [f.kind for f in found] == [Kind.MOVED, Kind.HIDDEN, Kind.DIRTY, Kind.DIRTY, Kind.GHOST,
                                       Kind.DEGRADED]  # fmt: skip
    assert [f.subject for f in found[:2]] == [3, 2]
    assert {f.subject for f in found[2:4]} == {6, 7}
    assert found[2].share > found[3].share
    words = ('mount it where', 'removed or something stands before it', 'clean or replace',
             'clean or replace', 'add it to the layout', 'A0')  # fmt: skip
    for f, word in zip(found, words, strict=True):
        assert word in f'{f.what}; {f.advice}'


@pytest.mark.parametrize('order', [(0, 1, 2, 3), (3, 2, 1, 0), (2, 0, 3, 1)])
def test_rank_is_of_the_kind_before_the_share(order):
    often, seldom = 0.9, 0.1
    best = [Finding(kind, -1, 0.0, 0.0, '', '', share) for kind, share in
            ((Kind.MOVED, seldom), (Kind.DIRTY, often), (Kind.DIRTY, seldom),
             (Kind.RESIDUALS, often))]  # fmt: skip
    assert ranked([best[k] for k in order]) == best


def test_noise_above_the_plan_is_a_finding():
    s = sightings(9, pose_error=0.0)
    s = replace(s, cov=s.cov / 4.0)
    found = audit(s).findings
    assert {f.kind for f in found} == {Kind.RESIDUALS}


def test_place_of_large_residuals_does_not_depend_on_health():
    s = sightings(9, pose_error=0.0)
    s = replace(s, cov=s.cov / 4.0)
    bad = (s.poses[:, 0] < -5.0) & (s.poses[:, 1] < -2.5)
    ill = replace(s, levels=bad.astype(int), reasons=bad.astype(int),
                  texts=np.array(['', 'wheels slip', record.OTHER]))  # fmt: skip
    places = [
        {(f.what, f.x, f.y) for f in audit(one).findings if f.kind is Kind.RESIDUALS}
        for one in (s, ill)
    ]
    assert Kind.DEGRADED in {f.kind for f in audit(ill).findings}
    assert places[0]
    assert places[0] == places[1]


def test_displacement_has_its_covariance():
    """Squared error over variance of a displaced reflector: 2 in the mean (chi2, 30 drives)."""
    total = []
    for seed in range(30):
        s = sightings(100 + seed, shifted(3, (0.06, 0.02)))
        d = displacement(gather(SITE, s, P, SENSOR), 0.0)
        total.append(np.sum((d.delta[3] - (0.06, 0.02)) ** 2) / d.sigma[3] ** 2)
        assert np.isnan(np.delete(d.delta, 3, axis=0)).all()
    # sigma is of the worst direction: a chi2 of one to two degrees of freedom, 30 times
    assert 0.6 < np.mean(total) < 2.7


def test_run_in_its_own_frame_is_placed_in_the_layout():
    site = sites.of_world(load_world('hall'))
    T = np.array([3.0, -2.0, 0.7])
    mapped = sites.known(site)
    mapped = replace(mapped, points=se2.transform(T, mapped.points),
                     cov=np.tile(1e-4 * np.eye(2), (len(mapped), 1, 1)))  # fmt: skip
    s = sightings()
    moved = replace(s, poses=se2.compose(T, s.poses))
    found = in_frame_of(site, moved, mapped)
    np.testing.assert_allclose(found.poses[:, :2], s.poses[:, :2], atol=1e-3)
    assert in_frame_of(SITE, s, sites.known(SITE)) is s


def test_run_of_another_place_is_refused():
    rng = np.random.default_rng(1)
    mapped = replace(sites.known(SITE), points=rng.uniform(100.0, 150.0, (10, 2)),
                     cov=np.tile(1e-4 * np.eye(2), (10, 1, 1)))  # fmt: skip
    with pytest.raises(MapError, match='not found in the layout'):
        in_frame_of(SITE, sightings(), mapped)
    s = sightings()
    far = replace(s, poses=s.poses + np.array([500.0, 0.0, 0.0]))
    with pytest.raises(MapError, match='no detection'):
        audit(far)


def frame(stamp: int, x: float, count: int = 3) -> Frame:
    found = Detections(stamp, 'base', np.full((count, 2), x), np.tile(np.eye(2), (count, 1, 1)),
                       np.full(count, -1), np.full(count, np.nan))  # fmt: skip
    pose = np.array([x, 0.0, 0.0])
    seen = Observation(stamp, Motion(np.zeros(3), np.eye(3)), detections=found)
    none = np.zeros(count, dtype=np.int64)
    return Frame(stamp, seen, pose, np.eye(3), pose, np.eye(3), none, none,
                 Health(Level.DEGRADED, (f'reason {stamp}',)))  # fmt: skip


def test_record_is_of_travel_and_bounded(monkeypatch):
    monkeypatch.setattr(record, 'MOST', 400)
    log = SightingLog()
    for k in range(20_000):
        log.add(frame(k, 0.01 * k))
    assert 50 < len(log) <= 100
    s = log.sightings(np.array([0]), np.array([[7.0, 8.0, 0.0]]))
    assert s.poses[0].tolist() == [7.0, 8.0, 0.0]
    assert len(s.texts) <= record.REASONS + 1
    steps = np.diff(s.poses[1:, 0])
    assert steps.min() > 0.9  # of a drive of 200 m, all along it
    assert s.poses[-1, 0] > 190.0


def test_record_is_read_as_written(tmp_path):
    s = sightings()
    record.save(s, tmp_path / 'a.rlml')
    record.save(s, tmp_path / 'b.rlml')
    assert (tmp_path / 'a.rlml').read_bytes() == (tmp_path / 'b.rlml').read_bytes()
    again = record.load(tmp_path / 'a.rlml')
    for name in vars(s):
        np.testing.assert_array_equal(getattr(again, name), getattr(s, name))


def test_damaged_record_is_refused(tmp_path):
    s, file = sightings(), tmp_path / 'a.rlml'
    with pytest.raises(MapError, match='not there'):
        record.load(file)
    bad = {
        'poses': s.poses[1:], 'scan': s.scan + 9999, 'points': np.inf * s.points,
        'levels': s.levels + 7, 'cov': s.cov[0], 'stamps': s.stamps[0],
    }  # fmt: skip
    for name, value in bad.items():
        record.save(replace(s, **{name: value}), file)
        with pytest.raises(FileFormatError):
            record.load(file)
    record.save(s, file)
    whole = file.read_bytes()
    for cut in (0, 1, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:cut])
        with pytest.raises(FileFormatError):
            record.load(file)


def test_site_is_read_as_written(tmp_path):
    site_file.save(SITE, tmp_path)
    with pytest.raises(FileFormatError, match=r'plan\.json'):
        site_file.read_plan(tmp_path)
    (tmp_path / 'plan.json').write_text('{"areas": [], "area_size_m": 5}')
    with pytest.raises(FileFormatError, match='no areas'):
        site_file.read_plan(tmp_path)
    (tmp_path / 'plan.json').write_text(
        '{"areas": [{"area": "A1", "x_m": 0, "y_m": 0}], "area_size_m": 5}'
    )
    site, plan = site_file.read_plan(tmp_path)
    np.testing.assert_array_equal(site.grid.cells, SITE.grid.cells)
    np.testing.assert_array_equal(site.reflectors.points, SITE.reflectors.points)
    assert (site.grid.origin, site.oriented) == (SITE.grid.origin, True)
    assert plan['area_size_m'] == 5
