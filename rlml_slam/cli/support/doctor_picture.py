# SPDX-License-Identifier: Apache-2.0
"""The picture of ``rlml doctor``: intensity against range, and its histogram."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rlml_slam.cli.support.doctor_evidence import KEPT, Evidence
from rlml_slam.report.pictures import FAINT, INK, REFLECTOR, SOFT, png


def picture(e: Evidence, figures: dict[str, Any]) -> bytes:
    """All beams and the reflectors' over range, the proposed threshold, and a histogram."""
    figure = Figure(figsize=(10.0, 4.6), layout='constrained')
    over, beside = figure.subplots(1, 2, sharey=True, width_ratios=[3.0, 1.0])
    stride = max(1, len(e.beams) // KEPT)
    sets = [('beams', e.beams[~e.is_spot], SOFT), ('on reflectors', e.beams[e.is_spot], REFLECTOR)]
    low = max(1.0, float(e.beams[:, 1].min())) if len(e.beams) else 1.0
    high = max(2.0 * low, float(e.beams[:, 1].max())) if len(e.beams) else 10.0
    bins = np.geomspace(low, 1.05 * high, 80)
    for label, points, colour in sets:
        r, bright = points[::stride].T
        over.plot(r, np.maximum(bright, low), '.', color=colour, markersize=1.5, label=label)
        beside.hist(points[:, 1], bins=bins, color=colour, orientation='horizontal', alpha=0.85)
    proposed = figures.get('proposed', {})
    if proposed.get('detector.threshold') == 'curve':
        r = np.linspace(0.0, float(e.beams[:, 0].max()), 200)
        curve = proposed['detector.curve_gain'] * np.exp(-proposed['detector.curve_decay'] * r)
        over.plot(
            r, curve + proposed['detector.intensity_floor'], color=INK, label='proposed threshold'
        )
    over.set_xlabel('range [m]', color=INK)
    over.set_ylabel('intensity', color=INK)
    over.set_yscale('log')
    beside.set_xscale('symlog')
    beside.set_xlabel('beams', color=INK)
    for axes in (over, beside):
        axes.grid(True, color=FAINT, linewidth=0.5)
        axes.set_axisbelow(True)
    over.legend(frameon=False, fontsize=8, markerscale=6.0, loc='upper right')
    return png(figure)
