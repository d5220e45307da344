# SPDX-License-Identifier: Apache-2.0
"""Without an IMU, the noise of the wheels in a sweep is most of what a pose errs by."""

from dataclasses import replace

import numpy as np
import pytest

from rlml_lab.studies.study_worlds import Case, drive
from rlml_slam.evaluation.metrics import run_errors
from rlml_slam.params import Parameters


@pytest.mark.parametrize('world', ['room', 'hall'])
def test_drive_without_imu_is_as_sure_as_it_may_be(world):
    params = Parameters()
    params = replace(params, node=replace(params.node, use_imu=False))
    # without the noise of sweeps in their matches, two seeds have 5.6 in the room, 4.3 in the hall
    errors = run_errors(drive(Case(world, 0), params))
    assert 0.7 < np.nanmean(errors.nees) < 3.5
