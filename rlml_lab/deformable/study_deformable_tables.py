# SPDX-License-Identifier: Apache-2.0
"""The tables of ``rlml-lab study deformable``, for the terminal and the page alike."""

from __future__ import annotations

from typing import Any


def tables(summary: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, header and cells of each table, for the terminal and the report alike."""
    rows = summary['rows']
    errors = [
        [name, *(_ci(r['ss3'][e]) for e in ('ekf', 'nls', 'rts', 'dead_reckoning')),
         f'{r["relative_to_dead_reckoning"]["ekf"]:.3f}',
         f'{r["relative_to_dead_reckoning"]["nls"]:.3f}',
         f'{r["unseen"][0]:.2f}', f'{r["path_m"][0]:.2f}', f'{r["mean_step_m"]:.3f}']
        for name, r in rows.items()
    ]  # fmt: skip
    paired = [
        [name, *(_ci(r['paired'][k], sign=True)
                 for k in ('nls-ekf', 'rts-ekf', 'nls-rts', 'ekf-dead_reckoning')),
         f'{100 * r["share_nls_below_ekf"]:.1f} %']
        for name, r in rows.items()
    ]  # fmt: skip
    consistency = [
        [name, f'{r["nees_nls"]["mean"]:.2f}', _bounds(r['nees_nls']),
         f'{r["nees_ekf"]["mean"]:.2f}', _bounds(r['nees_ekf']),
         f'{r["nees_ekf"]["steps_outside"]} of {r["nees_ekf"]["steps"]}',
         f'{100 * r["converged"]:.2f} %',
         f'{r["iterations"]["mean"]:.1f} / {r["iterations"]["max"]}']
        for name, r in rows.items()
    ]  # fmt: skip
    rmse = [
        [name, *(f'{r["position_rmse_m"][e]:.3f} / {1e3 * r["heading_rmse_rad"][e]:.1f}'
                 for e in ('ekf', 'nls', 'rts', 'dead_reckoning'))]
        for name, r in rows.items()
    ]  # fmt: skip
    out = [
        ('Pose error of one run: sum over 20 poses of dx² + dy² + dθ², mean ± 95 % CI',
         ['row', 'EKF', 'NLS', 'RTS', 'dead reckoning', 'EKF / d.r.', 'NLS / d.r.', 'unseen of 60',
          'path [m]', 'step [m]'], errors),
        ('Paired differences of it on the same seeds, mean ± 95 % CI',
         ['row', 'NLS − EKF', 'RTS − EKF', 'NLS − RTS', 'EKF − dead reckoning',
          'runs with NLS < EKF'], paired),
        ('Consistency: normalised error (NEES) with its 99.9 % bounds, and convergence',
         ['row', 'NLS, run', 'bounds (177)', 'EKF, steps', 'bounds per step (9)',
          'EKF steps outside', 'converged', 'iterations mean / max'], consistency),
        ('RMSE per pose: position [m] / heading [mrad]',
         ['row', 'EKF', 'NLS', 'RTS', 'dead reckoning'], rmse),
    ]  # fmt: skip
    pairs = summary['active_minus_predetermined']
    if pairs:
        out.append((
            'Active minus predetermined control on the same seeds, mean ± 95 % CI',
            ['path and noise', 'EKF', 'NLS', 'dead reckoning', 'EKF / d.r.', 'NLS / d.r.',
             'unseen', 'path [m]'],
            [[name, *(_ci(p[k], sign=True) for k in (
                'ss3_ekf', 'ss3_nls', 'ss3_dead_reckoning', 'relative_ekf', 'relative_nls',
                'unseen', 'path_m'))] for name, p in pairs.items()],
        ))  # fmt: skip
    return out


def _ci(interval: tuple[float, float], sign: bool = False) -> str:
    mean, half = interval
    return f'{mean:{"+" if sign else ""}.3f} ± {half:.3f}'


def _bounds(nees: dict[str, Any]) -> str:
    low, high = nees['bounds']
    return f'{low:.2f} … {high:.2f}'
