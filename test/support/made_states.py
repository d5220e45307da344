# SPDX-License-Identifier: Apache-2.0
"""Joint states to test with."""

import numpy as np

from rlml_slam.slam.front_end.joint_state import ANCHORS, BIAS, LANDMARKS, WHEELS, JointState


def made(seed=0, landmarks=3, theta=0.4, spread=2.0):
    """A state with every correlation there can be."""
    rng = np.random.default_rng(seed)
    state = JointState(np.zeros(3), np.zeros((3, 3)), 0.02, wheels=(0.03, 0.05, 0.03, 0.1))
    n = LANDMARKS + 2 * landmarks
    state.x = rng.normal(0.0, spread, n)
    state.x[2], state.x[BIAS], state.x[WHEELS] = theta, 0.01, (0.04, -0.03, 0.02, 0.05)
    for a in ANCHORS:
        state.x[a + 2] = rng.uniform(-3.0, 3.0)
    A = 0.05 * rng.standard_normal((n, n))
    state.P = A @ A.T + 1e-4 * np.eye(n)
    return state
