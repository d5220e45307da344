# SPDX-License-Identifier: Apache-2.0
"""Text files become a map again, to the last digit that they have."""

import sys
from pathlib import Path

import numpy as np
import pytest

from rlml_slam.cli.main import main
from rlml_slam.cli.map import map_export
from rlml_slam.cli.map.map_import import import_map
from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.params import Parameters
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.store import map_file
from rlml_slam.types import Detections, Odometry, Scan

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'rlml'))
from made_worlds import ROOM, drive, errors, messages

PARAMS = Parameters()
CURVE = drive((0.6, 0.0, 3.0), (0.6, 0.6, 4.0), (0.5, -0.7, 2.0))
AGAIN = drive((0.4, 0.4, 6.0), (0.5, -0.5, 3.0), start=(0.6, -1.2, 0.4))


def run(slam, poses, seed):
    slam.set_sensor_pose('laser', np.zeros(3))
    add = {Odometry: slam.add_odometry, Scan: slam.add_scan, Detections: slam.add_detections}
    for m in messages(ROOM, poses, rng=np.random.default_rng(seed)):
        add[type(m)](m)
    slam.finish()
    return slam


@pytest.fixture(scope='module')
def mapped():
    back_end = run(Slam(PARAMS), CURVE, 0).back_end
    return map_file.content_of(back_end, PARAMS, back_end.occupancy_grid())


@pytest.fixture
def folder(mapped, tmp_path):
    (tmp_path / 'text').mkdir()
    map_export.export(mapped, tmp_path / 'text')
    return tmp_path / 'text'


def test_text_becomes_the_same_graph(mapped, folder):
    content = import_map(folder)
    for name in ('pose', 'pose_fixed', 'key_stamp', 'edge_measured', 'edge_information',
                 'edge_nodes', 'sighted_measured', 'sighted_nodes'):  # fmt: skip
        kept = slice(None)
        if name.startswith(('edge', 'sighted')):  # what is disabled is not written
            kept = mapped.arrays[f'{name.split("_")[0]}_enabled']
        # the file's numbers are exact, but for headings that are wrapped again
        np.testing.assert_allclose(
            content.arrays[name], mapped.arrays[name][kept], rtol=0, atol=1e-9, err_msg=name
        )
    a, b = map_file.saved_map(content), map_file.saved_map(mapped)
    np.testing.assert_array_equal(a.reflectors.keys, b.reflectors.keys)
    np.testing.assert_allclose(a.reflectors.points, b.reflectors.points, atol=1e-12)
    np.testing.assert_array_equal(a.reflectors.sightings, b.reflectors.sightings)
    # an image knows occupied and free alone
    np.testing.assert_array_equal(a.grid.cells == 100, b.grid.cells >= 65)


def test_text_of_it_is_the_same_text(folder, tmp_path):
    again = tmp_path / 'again'
    again.mkdir()
    map_export.export(import_map(folder), again)
    for name in ('keyframes.tum', 'map.pgm', 'map.yaml'):
        assert (again / name).read_bytes() == (folder / name).read_bytes(), name
    lines = [(d / 'graph.g2o').read_text().splitlines() for d in (again, folder)]
    for a, b in zip(*lines, strict=True):
        assert a.split()[:2] == b.split()[:2]
        np.testing.assert_allclose(
            np.array(a.split()[1:], dtype=float), np.array(b.split()[1:], dtype=float),
            rtol=1e-9, atol=1e-9,
        )  # fmt: skip


@pytest.mark.parametrize('alone', [False, True])
def test_mapping_goes_on_with_it(folder, tmp_path, capsys, alone):
    if alone:
        (folder / 'graph.g2o').unlink()
    path = tmp_path / 'map.rlml'
    assert main(['map', 'import', str(folder), str(path)]) == 0
    assert f'{len(ROOM.reflectors)} reflectors' in capsys.readouterr().out
    slam = Slam(PARAMS)
    slam.continue_map(map_file.load(path))
    run(slam, AGAIN, 1)
    found = slam.reflectors()
    assert len(found) == len(ROOM.reflectors)
    gap = np.linalg.norm(found.points[:, None] - ROOM.reflectors, axis=-1)
    assert gap.min(axis=1).max() < 0.03
    assert errors(slam.trajectory()[1], AGAIN)[0].max() < 0.06


def test_name_of_a_whole_map_has_its_ending(folder, tmp_path, capsys):
    assert main(['map', 'import', str(folder), str(tmp_path / 'hall')]) == 1
    assert 'the name of a whole map ends with .rlml' in capsys.readouterr().err
    assert not (tmp_path / 'hall').exists()


def test_keyframes_of_another_graph_are_refused(folder):
    (folder / 'keyframes.tum').write_text('1.0 0 0 0 0 0 0 1\n')
    with pytest.raises(FileFormatError, match=r'keyframes.tum has 1 poses, graph.g2o \d+'):
        import_map(folder)


def test_reflectors_of_another_graph_are_refused(folder):
    table = folder / 'reflectors.csv'
    lines = table.read_text().splitlines()
    row = lines[1].split(',')
    table.write_text('\n'.join([lines[0], ','.join([*row[:2], '99', *row[3:]])]))
    with pytest.raises(FileFormatError, match=r'reflector \d+ of reflectors.csv is not in'):
        import_map(folder)


def test_empty_table_is_no_map(folder):
    (folder / 'graph.g2o').unlink()
    table = folder / 'reflectors.csv'
    table.write_text(table.read_text().splitlines()[0] + '\n')
    with pytest.raises(MapError, match='no reflector'):
        import_map(folder)
