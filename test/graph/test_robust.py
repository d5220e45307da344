# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from rlml_slam.errors import SolverError
from rlml_slam.graph.model.robust_loss import Loss, LossKind, loss


@pytest.mark.parametrize('kind', LossKind)
@pytest.mark.parametrize('scale', [0.5, 2.0])
def test_weight_is_the_derivative_of_the_loss(kind, scale):
    for s in np.linspace(0.01, 30.0, 57):
        h = 1e-6
        slope = (loss(kind, scale, s + h)[0] - loss(kind, scale, s - h)[0]) / (2 * h)
        if abs(s - scale**2) > 2 * h:  # truncated has a corner there
            assert loss(kind, scale, s)[1] == pytest.approx(slope, abs=1e-7)


@pytest.mark.parametrize('kind', LossKind)
def test_loss_is_quadratic_near_zero_and_never_exceeds_it(kind):
    assert loss(kind, 2.0, 0.0) == (0.0, 1.0)
    assert loss(kind, 2.0, 1e-8)[0] == pytest.approx(1e-8, rel=1e-7)
    for s in (0.1, 1.0, 4.0, 100.0, 1e12):
        rho, w = loss(kind, 2.0, s)
        assert 0.0 <= rho <= s
        assert 0.0 <= w <= 1.0


def test_scale_must_be_positive():
    with pytest.raises(SolverError, match=r'scale 0.0 of loss cauchy'):
        Loss(LossKind.CAUCHY, 0.0)
