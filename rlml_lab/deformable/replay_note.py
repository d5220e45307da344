# SPDX-License-Identifier: Apache-2.0
"""The note's own two runs, made again from its stored noise, with its leak on and off.

The note's world is not the matched experiment's: a base per feature walks, the feature is the
base plus construction noise of that step alone, the edges are exact, and on the circle the robot
drives with a heading that is half a step off. Its NLS was given the realised displacement of the
features as the smooth measurement (the leak), its EKF the nominal translation.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from rlml_lab.deformable.ekf import dead_reckoning, run_ekf
from rlml_lab.deformable.experiment import (
    FEATURES,
    PATHS,
    SENSORS,
    START_FEATURES,
    STEPS,
    TRAVEL,
    TURN,
    Measurements,
    edges,
    nominal,
)
from rlml_lab.deformable.nls import run_nls
from rlml_lab.deformable.rts import run_rts
from rlml_lab.deformable.scoring import ss3
from rlml_slam.deformable.model import Noise
from rlml_slam.errors import FileFormatError
from rlml_slam.se2 import Array, rotation

TABLE_1 = {'straight': {'ekf': 0.1629, 'nls': 0.1238}, 'circle': {'ekf': 0.1460, 'nls': 0.0616}}
_SHAPES = {
    'noise_odem': (3, STEPS),
    'noise_smoo': (FEATURES, STEPS, 2),
    'noise_cons': (FEATURES, STEPS, 2),
    'noise_feat': (FEATURES, STEPS, 2),
}


def read_noise(directory: str | Path) -> dict[str, Array]:
    """The arrays of ``stored_noise.json``: odometry (3, N) of (theta, x, y), the rest (M, N, 2).

    Raises FileFormatError where the file is missing or malformed.
    """
    path = Path(directory) / 'stored_noise.json'
    try:
        stored = json.loads(path.read_text(encoding='utf-8'))
        noise = {name: np.asarray(stored[name], dtype=np.float64) for name in _SHAPES}
    except OSError as e:
        raise FileFormatError(f'{path}: cannot be read: {e.strerror}') from e
    except (ValueError, TypeError, KeyError) as e:
        raise FileFormatError(f'{path}: not the stored noise of the note: {e}') from e
    for name, shape in _SHAPES.items():
        if noise[name].shape != shape or not np.isfinite(noise[name]).all():
            raise FileFormatError(f'{path}: {name} is not {shape} finite numbers')
    return noise


def make_run(path: str, noise: dict[str, Array], leak: bool) -> tuple[Array, Measurements]:
    """True states (1, N, n) and measurements of the note's run; ``leak`` in the smooth ones."""
    turn = TURN if path == 'circle' else 0.0
    control = np.tile([TRAVEL * np.cos(turn), TRAVEL * np.sin(turn), turn], (STEPS - 1, 1))
    translation = nominal(path).translation[: STEPS - 1]
    truth = np.zeros((STEPS, 3 + 2 * FEATURES))
    base = START_FEATURES + np.concatenate(
        [np.zeros((1, FEATURES, 2)),
         np.cumsum(translation[:, None] + noise['noise_smoo'].swapaxes(0, 1)[:-1], 0)]
    )  # fmt: skip
    features = base + noise['noise_cons'].swapaxes(0, 1)
    for i, u in enumerate(control):
        truth[i + 1, :2] = truth[i, :2] + rotation(truth[i, 2]) @ u[:2]
        truth[i + 1, 2] = truth[i, 2] + u[2]
        truth[i + 1, :3] += noise['noise_odem'][[1, 2, 0], i + 1]
    truth[:, 3:] = features.reshape(STEPS, -1)
    sensor = SENSORS['fixed']
    seen = np.einsum(
        'nba,njb->nja', rotation(truth[:, 2]), features - truth[:, None, :2]
    )  # R^T (f - p)
    distance = np.linalg.norm(seen, axis=-1)
    visible = (distance >= sensor.near) & (distance <= sensor.far)
    feature = np.where(visible[..., None], seen + noise['noise_feat'].swapaxes(0, 1), np.nan)
    sigma = np.where(visible, sensor.sigma_near, np.nan)
    pairs = edges(FEATURES)
    edge = features[:, pairs[:, 1]] - features[:, pairs[:, 0]]
    drift = np.repeat(translation[:, None], FEATURES, 1)
    if leak:
        drift = features[1:] - base[:-1]
    return truth[None], Measurements(*(a[None] for a in (control, drift, feature, sigma, edge)))


def replay(directory: str | Path) -> dict[str, Any]:
    """Pose errors (ss3) of both paths, leak on and off, beside the note's Table 1.

    ``ekf_leaked`` is the EKF with the same leak, which the note never showed; ``rts`` and
    ``dead_reckoning`` are on the nominal translation.
    """
    noise, known = read_noise(directory), Noise()
    out: dict[str, Any] = {}
    for path in PATHS:
        truth, fair = make_run(path, noise, leak=False)
        _, leaked = make_run(path, noise, leak=True)

        def score(mean: Array, truth: Array = truth) -> float:
            return float(ss3(truth, mean)[0])

        ekf = run_ekf(_note_ekf(fair), known)
        out[path] = {
            'note': TABLE_1[path],
            'leak_on': {'ekf': score(ekf.mean), 'nls': score(run_nls(leaked, known).mean)},
            'leak_off': {'ekf': score(ekf.mean), 'nls': score(run_nls(fair, known).mean)},
            'ekf_leaked': score(run_ekf(_note_ekf(leaked), known).mean),
            'rts': score(run_rts(fair, known, ekf).mean),
            'dead_reckoning': score(dead_reckoning(fair)),
        }
    return out


def _note_ekf(m: Measurements) -> Measurements:
    """What the note's EKF used: it starts from the sightings of step 1, without its edges."""
    edge = m.edge.copy()
    edge[:, 0] = np.nan
    return Measurements(m.control, m.drift, m.feature, m.sigma, edge)
