# SPDX-License-Identifier: Apache-2.0
"""What the back end reads of a frame is the same after a way through columns."""

import dataclasses
import pickle

import numpy as np
import pytest

from rlml_slam.slam.offline.frame_batch import ARRAYS, NONE, VALUES, packed, unpacked
from rlml_slam.types import Detections, Frame, Motion, Observation


def frame(rng, points=None, detections=None):
    motion = Motion(rng.random(3), rng.random((3, 3)), bool(rng.random() < 0.5), rng.random(3))
    origin = None if points is None else rng.random(2)
    seen = Observation(int(rng.integers(1 << 60)), motion, points, origin, detections)
    landmarks = NONE if detections is None else np.arange(len(detections))
    return Frame(
        seen.stamp, seen, rng.random(3), rng.random((3, 3)), rng.random(3), rng.random((3, 3)),
        landmarks, NONE, scan_score=rng.random(), scan_used=points is not None,
        unconfirmed=bool(rng.random() < 0.5), jumped=bool(rng.random() < 0.5),
    )  # fmt: skip


def looked(n):
    """Detections of n reflectors; there may be none, which says more than not to have looked."""
    return Detections(
        5, 'base', np.ones((n, 2)), np.ones((n, 2, 2)), np.zeros(n, np.int64), np.ones(n)
    )


@pytest.fixture
def frames():
    rng = np.random.default_rng(1)
    return [
        frame(rng, rng.random((7, 2))),
        frame(rng),
        frame(rng, rng.random((0, 2)), looked(0)),
        frame(rng, rng.random((3, 2)), looked(2)),
        frame(rng, None, looked(1)),
    ]


def same(a, b):
    if isinstance(a, np.ndarray):
        return a.tobytes() == b.tobytes() and a.shape == b.shape
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    return a == b


@pytest.mark.parametrize('num', [1, 2, 5])
def test_frames_arrive_as_they_were(frames, num):
    arrived = unpacked(pickle.loads(pickle.dumps(packed(frames[:num]))))
    assert len(arrived) == num
    for sent, got in zip(frames, arrived, strict=False):
        assert VALUES(sent) == VALUES(got)
        assert all(same(array(sent), array(got)) for array in ARRAYS)
        a, b = sent.observation, got.observation
        assert a.stamp == b.stamp
        for name in ('points', 'origin', 'detections'):
            assert same(getattr(a, name), getattr(b, name)), name
        assert same(sent.landmarks, got.landmarks)


def test_what_the_back_end_must_not_read_is_not_a_number(frames):
    for got in unpacked(packed(frames)):
        assert np.isnan(got.T_map_base).all()
        assert np.isnan(got.cov_map).all()
