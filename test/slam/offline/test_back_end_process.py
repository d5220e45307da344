# SPDX-License-Identifier: Apache-2.0
"""Two processes with narrow pipes between them: neither may wait for the other for ever."""

import signal
from dataclasses import replace

import numpy as np
import pytest
from made_worlds import ROOM, drive, observations

from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.back_end import BackEnd, Update
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.offline import back_end_process

MUCH = tuple(range(100_000))  # more than a pipe holds


@pytest.fixture
def patience():
    """A wait without end is an error after a minute."""

    def fail(number, frame):
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures('patience')
@pytest.mark.parametrize('batch', [1, 7])
def test_large_frames_and_large_answers_pass_one_another(monkeypatch, batch):
    monkeypatch.setattr(back_end_process, 'PIPE', 4096)
    monkeypatch.setattr(back_end_process, 'BATCH', batch)
    seen = next(iter(observations(ROOM, drive((0.5, 0.0, 1.0)))))
    seen = replace(seen, points=np.ones((20_000, 2)))
    frame = FrontEnd(Parameters()).process(replace(seen, points=None))
    frame = replace(frame, observation=seen)

    def answer(_back_end, got):
        assert got.observation.points.shape == (20_000, 2)
        return Update(0, np.zeros(3), False, (), 0.0, removed=MUCH)

    other = back_end_process.BackEndProcess(BackEnd(Parameters()), answer)
    for _ in range(30):
        other.add(frame)
    assert all(other.update().removed == MUCH for _ in range(30))
    assert isinstance(other.bring_home(), BackEnd)
