# SPDX-License-Identifier: Apache-2.0
"""Frames on their way from the front end to the back end."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rlml_slam.errors import InputError
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.correction_message import build_correction, read_correction
from rlml_slam.ros.codecs.frame_messages import (
    MAX_BEHIND,
    FrameAssembler,
    build_points,
    build_record,
    read_points,
    read_record,
)
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.ros.codecs.reflector_clouds import (
    build_associated,
    build_reflector_map,
    read_associated,
    read_reflector_map,
)
from rlml_slam.ros.codecs.request_message import build_request, read_request
from rlml_slam.slam.conversation import Correct, Relocate, SessionFrame, StartSession
from rlml_slam.types import (
    Belief,
    Detections,
    Frame,
    Health,
    Level,
    Motion,
    Observation,
    Reflectors,
    Status,
)

# the raw sweep and how it was de-skewed are the front end's; the reasons are on /diagnostics
LEFT_OUT = (
    '.observation.scan', '.observation.T_base_laser', '.observation.sweep', '.health.reasons'
)  # fmt: skip
SECOND = 1_000_000_000


def a_frame(stamp=SECOND, seed=0, n=3):
    """A frame in which no field has its default."""
    rng = np.random.default_rng(seed)

    def cov(k):
        A = rng.normal(size=(k, k))
        return A @ A.T

    motion = Motion(rng.normal(size=3), cov(3), False, rng.normal(size=3), 0.1, 0.2)
    covs = np.array([cov(2) for _ in range(n)]).reshape(n, 2, 2)
    seen = Detections(
        stamp, 'base_link', rng.normal(size=(n, 2)), covs, rng.integers(9, size=n), rng.random(n)
    )
    observation = Observation(
        stamp, motion, rng.normal(size=(50, 2)), rng.normal(size=2), seen, None,
        rng.normal(size=3), rng.normal(size=3), rng.normal(size=3),
    )  # fmt: skip
    return Frame(
        stamp, observation, rng.normal(size=3), cov(3), rng.normal(size=3), cov(3),
        rng.integers(-1, 9, size=n), rng.integers(5, size=n), Health(Level.DEGRADED, ('why',)),
        scan_score=0.7, scan_used=True, chi2=3.5, iterations=4, wall_ms=1.5,
    )  # fmt: skip


@pytest.mark.parametrize(
    ('field', 'value'),
    [
        ('bias_var', 0.0), ('bias_var', -1.0), ('bias_var', 5e-324), ('bias_var', np.nan),
        ('bias', np.nan), ('bias_gain', np.array([0.0, np.inf, 0.0])),
    ],
)  # fmt: skip
def test_bias_that_cannot_be_is_refused(field, value):
    frame = a_frame()
    motion = dataclasses.replace(frame.observation.motion, **{field: value})
    observation = dataclasses.replace(frame.observation, motion=motion)
    frame = dataclasses.replace(frame, observation=observation)
    msg = build_record(make_bag, SessionFrame(1, frame, 8, 9), 'local')
    with pytest.raises(InputError, match=f'rlml/frames: {field}'):
        read_record(msg)


def send(join, frame, session=1, parts='pdr'):
    """Give a frame's messages to the join in the order of ``parts``; what came out."""
    out = []
    for part in parts:
        if part == 'p':
            msg = build_points(make_bag, frame.stamp, 'base_link', frame.observation.points)
            out += join.add_points(frame.stamp, read_points(msg))
        elif part == 'd':
            msg = build_associated(make_bag, frame, 'base_link')
            out += join.add_associated(read_associated(msg))
        else:
            out += join.add_record(
                read_record(build_record(make_bag, SessionFrame(session, frame, 8, 9), 'local'))
            )
    return out


def assert_equal(got, want, exact, path=''):
    if dataclasses.is_dataclass(want):
        for f in dataclasses.fields(want):
            name = f'{path}.{f.name}'
            if name in LEFT_OUT:
                continue
            assert_equal(getattr(got, f.name), getattr(want, f.name), exact, name)
    elif isinstance(want, np.ndarray) and not exact and path.startswith('.observation.'):
        # float32 on the wire for points and detections
        np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-7, err_msg=path)
    else:
        np.testing.assert_array_equal(got, want, err_msg=path)


def test_every_field_of_a_frame_travels():
    want = a_frame()
    (record,) = send(FrameAssembler(), want, session=7)
    assert (record.session, record.request, record.mode) == (7, 8, 9)
    assert_equal(record.frame, want, exact=False)


def test_figures_travel_exactly():
    want = a_frame()
    got = read_record(build_record(make_bag, SessionFrame(1, want), 'local')).of.frame
    for name in ('T_local_base', 'cov_local', 'T_map_base', 'cov_map', 'scan_score'):
        assert_equal(getattr(got, name), getattr(want, name), exact=True)
    assert_equal(got.observation.motion, want.observation.motion, exact=True)
    assert_equal(got.observation.odom_pose, want.observation.odom_pose, exact=True)


@pytest.mark.parametrize('order', ['pdr', 'prd', 'rdp', 'drp'])
def test_parts_come_in_any_order(order):
    assert len(send(FrameAssembler(), a_frame(), parts=order)) == 1


def test_frame_without_scan_or_detections_is_whole_at_once():
    frame = a_frame()
    bare = dataclasses.replace(frame.observation, points=None, origin=None, detections=None)
    frame = dataclasses.replace(
        frame, observation=bare, landmarks=frame.landmarks[:0], statuses=frame.statuses[:0]
    )
    (record,) = send(FrameAssembler(), frame, parts='r')
    assert_equal(record.frame, frame, exact=True)


def test_frames_keep_their_order():
    join = FrameAssembler()
    first, second = a_frame(SECOND), a_frame(2 * SECOND, 1)
    assert send(join, first, parts='rp') == []
    assert send(join, second, parts='rpd') == []
    both = send(join, first, parts='d')
    assert [r.frame.stamp for r in both] == [SECOND, 2 * SECOND]


def test_lost_part_costs_only_itself():
    join = FrameAssembler()
    out = send(join, a_frame(SECOND), parts='rd')
    for k in range(MAX_BEHIND):
        out += send(join, a_frame((k + 2) * SECOND, k))
    assert len(out) == MAX_BEHIND + 1
    assert join.incomplete == 1
    assert out[0].frame.observation.points is None
    assert len(out[0].frame.observation.detections) == 3


def test_parts_whose_records_never_come_are_kept_for_a_while():
    join = FrameAssembler()
    for k in range(5 * MAX_BEHIND):
        assert send(join, a_frame((k + 1) * SECOND), parts='pd') == []
    assert len(join._points) == len(join._associated) == 2 * MAX_BEHIND
    assert len(send(join, a_frame(5 * MAX_BEHIND * SECOND), parts='r')) == 1
    assert join.incomplete == 0


def test_other_clouds_are_refused():
    msg = build_points(make_bag, SECOND, 'base_link', np.zeros((1, 2)))
    with pytest.raises(InputError, match='frames: 1 points; missing fields: session'):
        read_record(msg)
    with pytest.raises(
        InputError, match='reflectors/associated: 1 points; missing fields: cov_xx'
    ):
        read_associated(msg)


def test_pose_that_is_not_finite_is_refused():
    frame = dataclasses.replace(a_frame(), T_local_base=np.array([np.nan, 0, 0]))
    with pytest.raises(InputError, match='frames: T_local_base is not finite'):
        read_record(build_record(make_bag, SessionFrame(1, frame), 'local'))


def test_reflector_map_travels():
    seen = a_frame().observation.detections
    want = Reflectors(
        np.arange(3), seen.points, seen.cov, seen.ids, np.array([3, 4, 5]), seen.diameters
    )
    got = read_reflector_map(build_reflector_map(make_bag, SECOND, 'map', want))
    assert_equal(got, want, exact=False, path='.observation.')


def test_statuses_are_those_of_the_enumeration():
    frame = dataclasses.replace(a_frame(n=len(Status)), statuses=np.arange(len(Status)))
    got = read_associated(build_associated(make_bag, frame, 'base_link'))
    assert [Status(s) for s in got.statuses] == list(Status)


def test_header_of_the_clouds_is_the_frame():
    msg = build_record(make_bag, SessionFrame(1, a_frame()), 'local')
    assert msg.header == encode.header(make_bag, SECOND, 'local')


def test_belief_travels_exactly():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(9, 9))
    belief = Belief(
        rng.normal(size=3),
        np.array([2, 5, 7]),
        rng.normal(size=(3, 2)),
        A @ A.T,
        {3: 2, 9: 5},
        (4, 9),
    )
    want = Correct(12345, SECOND, rng.normal(size=3), A[:3, :3] @ A[:3, :3].T, (6, 1), belief)
    assert_equal(read_correction(build_correction(make_bag, want, 'map')), want, exact=True)
    bare = Belief(np.zeros(3), np.zeros(0, np.int64), np.zeros((0, 2)), np.eye(3), {})
    for want in (
        Correct(1, 1, np.zeros(3), None, (), bare),
        Correct(1, 1, np.zeros(3), np.eye(3)),
        Correct(1, 1, None, removed=(4,)),
        Correct(1, 1, None),
    ):
        got = read_correction(build_correction(make_bag, want, 'map'))
        assert_equal(got, want, exact=True)


def test_belief_that_contradicts_itself_is_refused():
    belief = Belief(np.zeros(3), np.array([1]), np.zeros((1, 2)), np.eye(5), {})
    msg = build_correction(make_bag, Correct(1, 1, np.zeros(3), None, (), belief), 'map')
    msg.width -= 1  # the last landmark row
    with pytest.raises(InputError, match='rlml/graph_correction: 4 values do not fit'):
        read_correction(msg)


@pytest.mark.parametrize('name', ['session', 'kind', 'key', 'value', 'cov'])
def test_correction_whose_fields_have_other_types_is_refused(name):
    """A session that is declared as a float may be NaN, which is no number of a session."""
    msg = build_correction(make_bag, Correct(1, 1, np.zeros(3), np.eye(3), (4,)), 'map')
    field = next(f for f in msg.fields if f.name == name)
    field.datatype = 7 if field.datatype != 7 else 6
    with pytest.raises(InputError, match=f'rlml/graph_correction: .*missing fields: .*{name}'):
        read_correction(msg)


@pytest.mark.parametrize('kind', [StartSession, Relocate])
def test_request_travels_exactly(kind):
    rng = np.random.default_rng(0)
    more = (17,) if kind is StartSession else ()
    want = kind(
        2_000_000_000,
        2**32 - 1,
        SECOND,
        rng.normal(size=3),
        np.cov(rng.normal(size=(3, 9))),
        *more,
    )
    assert_equal(read_request(build_request(make_bag, want, 'map')), want, exact=True)


def test_session_starts_at_no_stamp_that_no_clock_has():
    start = StartSession(2, 1, 0, np.zeros(3), np.eye(3), 3)
    msg = build_request(make_bag, start, 'map')
    assert read_request(msg).stamp == 0  # now
    for sec, nanosec in ((0, SECOND), (-1, 0)):
        msg.header.stamp = make_bag('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
        with pytest.raises(InputError, match=r'rlml/session_start: header\.stamp'):
            read_request(msg)


@pytest.mark.parametrize('far', [np.nan, np.inf, 600.0, -1e9])
def test_end_point_that_no_beam_reaches_is_refused(far):
    near = np.array([[300.0, -1.0], [2.0, 3.0]])
    np.testing.assert_array_equal(read_points(build_points(make_bag, 1, 'base', near)), near)
    with pytest.raises(InputError, match='deskewed_points: a point is not finite, or beyond 500'):
        read_points(build_points(make_bag, 1, 'base', np.vstack([near, [0.0, far]])))


def test_request_that_is_not_finite_is_refused():
    msg = build_request(make_bag, Relocate(2, 1, 1, np.full(3, np.nan), np.eye(3)), 'map')
    with pytest.raises(InputError, match='not finite'):
        read_request(msg)
