# SPDX-License-Identifier: Apache-2.0
"""What a buffer of tf2 answers: its rules, as tf2's buffer_core.cpp and time_cache.cpp have them.

A transform is linear between two of its stamps, and refused before the oldest and after the
newest. A repeated stamp is ignored. A chain is composed of all of its transforms at one time.
"""

from __future__ import annotations

from bisect import bisect_left, insort

import numpy as np

from rlml_slam import se2

KEPT = 10 * 1_000_000_000  # [ns]


class Refused(Exception):
    """LookupException or ExtrapolationException."""


class Buffer:
    """Planar transforms by (parent, child)."""

    def __init__(self, kept=KEPT):
        self.stamps, self.poses, self.repeated, self.kept = {}, {}, 0, kept

    def add(self, stamp, edge, pose):
        stamps, poses = self.stamps.setdefault(edge, []), self.poses.setdefault(edge, {})
        if stamp in poses:
            self.repeated += 1
            return
        insort(stamps, stamp)
        poses[stamp] = np.array(pose)
        while stamps[0] < stamps[-1] - self.kept:
            del poses[stamps.pop(0)]

    def at(self, stamp, edge):
        stamps, poses = self.stamps.get(edge, []), self.poses.get(edge)
        if not stamps or not stamps[0] <= stamp <= stamps[-1]:
            raise Refused(f'{edge} at {stamp}: known from {stamps[:1]} to {stamps[-1:]}')
        k = bisect_left(stamps, stamp)
        if stamps[k] == stamp:
            return poses[stamp]
        t0, t1 = stamps[k - 1], stamps[k]
        a, b = poses[t0], poses[t1]
        step = np.array([*(b - a)[:2], se2.wrapped(b[2] - a[2])])
        return a + (stamp - t0) / (t1 - t0) * step

    def chain(self, stamp, *edges):
        T = np.zeros(3)
        for edge in edges:
            T = se2.compose(T, self.at(stamp, edge))
        return T
