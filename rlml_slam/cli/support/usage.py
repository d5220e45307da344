# SPDX-License-Identifier: Apache-2.0
"""CPU time and memory of processes over a run, from /proc."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

SETTLED = 0.25  # share of the samples that are left out of growth: buffers and caches fill first


@dataclass(frozen=True)
class Usage:
    """CPU time so far [s], resident memory now and at its largest [MB], at a ``time`` [s]."""

    time: float
    cpu_s: float
    rss_mb: float
    peak_rss_mb: float


def usage(pid: int, time: float) -> Usage | None:
    """Of one process; None where it has ended or the system does not say."""
    try:
        # the command's name may hold spaces and brackets: fields are counted after it
        fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
        status = Path(f'/proc/{pid}/status').read_text()
    except OSError:
        return None
    kb = {k: int(v.split()[0]) for k, _, v in (s.partition(':') for s in status.splitlines())
          if k in ('VmRSS', 'VmHWM')}  # fmt: skip
    if len(kb) < 2:
        return None
    cpu = (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')
    return Usage(time, cpu, kb['VmRSS'] * 1024 / 1e6, kb['VmHWM'] * 1024 / 1e6)


def summary(samples: list[Usage]) -> dict[str, Any]:
    """Share of one core, peak memory, and growth of memory per minute once it has settled.

    Growth is the slope of a line through the samples, None of less than ten.
    """
    first, last = samples[0], samples[-1]
    elapsed = last.time - first.time
    settled = samples[int(SETTLED * len(samples)) :]
    growth = None
    if len(settled) >= 10:
        t = np.array([s.time for s in settled])
        rss = np.array([s.rss_mb for s in settled])
        growth = round(60.0 * float(np.polyfit(t - t[0], rss, 1)[0]), 3)
    return {
        'cpu_share': round((last.cpu_s - first.cpu_s) / elapsed, 3) if elapsed > 0.0 else None,
        'peak_rss_mb': round(last.peak_rss_mb, 1),
        'rss_growth_mb_per_min': growth,
    }
