# SPDX-License-Identifier: Apache-2.0
"""The files of a run; each appears whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam.datasets.tum import Trajectory, write_tum
from rlml_slam.errors import MapError
from rlml_slam.evaluation.metrics import RunErrors, metrics, run_errors
from rlml_slam.evaluation.run_folder import HEALTH, health_table
from rlml_slam.evaluation.run_record import Run
from rlml_slam.maps import map_container, reflector_file
from rlml_slam.maps.atomic_file import set_aside, write_atomically
from rlml_slam.maps.nav2_map import save
from rlml_slam.maps.occupancy import UNKNOWN, OccupancyGrid
from rlml_slam.planning.audit.sightings import save as save_sightings
from rlml_slam.slam.landmarks.reflector_states import state_table

SIGHTINGS = 'sightings.rlml'


def write_outputs(
    run: Run, folder: str | Path, report: bool = True, known: Path | None = None
) -> dict[str, Any]:
    """Write all results of a run into a folder; the figures of metrics.json.

    trajectory.tum, front_end.tum, health.csv, map.rlml, map.pgm, map.yaml, reflectors.csv,
    reflector_states.csv, sightings.rlml and closures.csv depend on the data alone: two replays
    give the same bytes. Without ``report`` there is no report.html. What this run does not write
    is of an earlier one, and set aside as ``.previous``, but for ``known``, the map that the run
    localized in, whose files stay as they are. Raises MapError if the folder cannot be written.
    """
    folder = make_folder(folder)
    is_written = {
        'map.rlml': run.stored is not None, SIGHTINGS: len(run.frames.sightings) > 0,
        'closures.csv': bool(run.closure_table), 'report.html': report,
        'reflector_states.csv': bool(run.reflector_states),
    }  # fmt: skip
    others = [folder / name for name, is_new in is_written.items() if not is_new]
    is_used = known is not None and folder.resolve() in (known.resolve(), known.resolve().parent)
    set_aside(*(p for p in others if not is_used or p.name != 'map.rlml'))
    write_tum(folder / 'trajectory.tum', run.trajectory)
    write_tum(folder / 'front_end.tum', run.frames.trajectory())
    write_atomically(folder / HEALTH, health_table(run.frames).encode())
    if not is_used:  # else these are of the map that the run localized in
        save(run.grid if run.grid is not None else unknown_grid(run.trajectory), folder / 'map')
        reflector_file.save(run.reflectors, folder / 'reflectors.csv')
    if run.stored is not None:
        map_container.write(folder / 'map.rlml', run.stored)
    if len(run.frames.sightings):
        path = run.trajectory
        save_sightings(run.frames.sightings.sightings(path.stamps, path.poses),
                       folder / SIGHTINGS)  # fmt: skip
    if run.closure_table:
        write_atomically(folder / 'closures.csv', run.closure_table.encode())
    if run.reflector_states:
        table = state_table(run.reflector_states)
        write_atomically(folder / 'reflector_states.csv', table.encode())
    errors = run_errors(run)
    figures = metrics(run, errors)
    write_json(folder / 'metrics.json', figures)
    if report:
        write_report(run, errors, figures, folder)
    return figures


def make_folder(folder: str | Path) -> Path:
    """The folder, made if need be; MapError if it is a bag, or nothing can be written there."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise MapError(f'{folder}: cannot be made: {e.strerror}') from e
    if (folder / 'metadata.yaml').exists() or any(folder.glob('*.db3')):
        raise MapError(f'{folder} is a bag: name another folder for what is written')
    if not os.access(folder, os.W_OK):
        raise MapError(f'{folder}: cannot be written')
    return folder


def write_json(path: Path, figures: Mapping[str, Any]) -> None:
    """Figures as a file that people can read, too."""
    write_atomically(path, (json.dumps(figures, indent=2) + '\n').encode())


def write_report(
    run: Run, errors: RunErrors | None, figures: dict[str, Any], folder: Path
) -> None:
    """report.html, which needs no other file."""
    # Bokeh takes a second to import, which other commands need not wait for
    from rlml_slam.report.report import report_html

    write_atomically(
        folder / 'report.html', report_html(run, figures, errors).encode('utf-8', 'replace')
    )


def unknown_grid(trajectory: Trajectory) -> OccupancyGrid:
    """A map without any knowledge, around the trajectory: what a run without scans has.

    Cells of 5 cm, or larger ones where more than 2000 of them would lie side by side.
    """
    xy = trajectory.poses[:, :2] if len(trajectory) else np.zeros((1, 2))
    low, high = np.floor(xy.min(axis=0) - 1.0), np.ceil(xy.max(axis=0) + 1.0)
    resolution = max(0.05, float((high - low).max()) / 2000.0)
    columns, rows = np.round((high - low) / resolution).astype(int)
    cells = np.full((rows, columns), UNKNOWN, dtype=np.int8)
    return OccupancyGrid(resolution, (float(low[0]), float(low[1])), cells)
