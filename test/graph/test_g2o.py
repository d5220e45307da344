# SPDX-License-Identifier: Apache-2.0
import gzip

import numpy as np
import pytest
from made_graphs import loop_graph

from rlml_slam.errors import FileFormatError
from rlml_slam.graph.g2o import read_graph, write_graph
from rlml_slam.graph.model.factors import FactorKind
from rlml_slam.graph.model.graph import Graph

G2O = """\
# two poses that see one tree
VERTEX_SE2 10 0 0 0
VERTEX_SE2 11 1 0 0.1
VERTEX_XY 5 2 2
FIX 10
EDGE_SE2 10 11 1 0 0.1 1 2e-1 3e-1 4 5e-1 6
EDGE_SE2 11 10 -1 0 -0.1 1 0 0 1 0 1
EDGE_SE2_XY 11 5 1 2 7 0.5 8

EDGE_PRIOR_SE2 11 1 0 0 1 0 0 4 0 9
DATA_FEATURE_POINTXY 1 2 3
"""
TORO = 'VERTEX2 0 0 0 0\nVERTEX2 2 1 0 0\nEDGE2 0 2 1 0 0 1 2e-1 4 6 3e-1 5e-1\nEQUIV 0 2\n'


def write(tmp_path, text, name='graph.g2o'):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_g2o_is_read_as_it_stands(tmp_path):
    file = read_graph(write(tmp_path, G2O))
    graph = file.graph
    assert list(file.pose_ids) == [10, 11]
    assert list(file.landmark_ids) == [5]
    assert file.skipped == {'DATA_FEATURE_POINTXY': 1}
    np.testing.assert_array_equal(graph.fixed_poses, [True, False])
    np.testing.assert_array_equal(graph.edges.nodes, [[0, 1], [1, 0]])
    assert list(graph.edges.kinds) == [FactorKind.ODOMETRY] * 2
    np.testing.assert_array_equal(
        graph.edges.information[0], [[1, 0.2, 0.3], [0.2, 4, 0.5], [0.3, 0.5, 6]]
    )
    np.testing.assert_array_equal(graph.sightings.information[0], [[7, 0.5], [0.5, 8]])


def test_toro_has_its_own_order_of_the_information(tmp_path):
    file = read_graph(write(tmp_path, TORO, 'w.graph'))
    np.testing.assert_array_equal(
        file.graph.edges.information[0], [[1, 0.2, 0.3], [0.2, 4, 0.5], [0.3, 0.5, 6]]
    )
    # ids 0 and 2, but no pose lies between them
    assert list(file.graph.edges.kinds) == [FactorKind.ODOMETRY]
    assert file.graph.fixed_poses[0]
    assert file.skipped == {'EQUIV': 1}


@pytest.mark.parametrize('name', ['a.g2o', 'a.g2o.gz'])
def test_graph_reads_back_to_the_same_bits(tmp_path, name):
    graph, _, _ = loop_graph(seed=1, start_noise=1.0)
    write_graph(tmp_path / name, graph)
    back = read_graph(tmp_path / name).graph
    assert back.poses.tobytes() == graph.poses.tobytes()
    assert back.landmarks.tobytes() == graph.landmarks.tobytes()
    for a, b in ((back.edges, graph.edges), (back.sightings, graph.sightings)):
        np.testing.assert_array_equal(a.nodes, b.nodes)
        np.testing.assert_array_equal(a.measured, b.measured)
        np.testing.assert_array_equal(a.information, b.information)
    np.testing.assert_array_equal(back.fixed_poses, graph.fixed_poses)


def test_toro_reads_back(tmp_path):
    graph, _, _ = loop_graph(seed=2, landmarks=0)
    write_graph(tmp_path / 'a.graph', graph)
    back = read_graph(tmp_path / 'a.graph').graph
    np.testing.assert_array_equal(back.edges.information, graph.edges.information)
    assert back.chi2() == graph.chi2()


def test_priors_and_ids_survive_and_disabled_factors_do_not(tmp_path):
    graph, _, points = loop_graph(seed=3, landmarks=3)
    A = np.array([[5.0, 1, 0.5], [1, 3, 0.2], [0.5, 0.2, 8]])
    graph.add_pose_prior(4, graph.poses[4] + [0.1, 0.2, 0.3], A)
    graph.add_landmark_prior(1, points[1] + 0.1, [[3, 1], [1, 2]])
    graph.edges.enabled[3] = False
    ids = 100 + np.arange(len(graph.poses))
    write_graph(tmp_path / 'a.g2o', graph, ids, [7, 8, 9])
    file = read_graph(tmp_path / 'a.g2o')
    assert list(file.landmark_ids) == [7, 8, 9]
    np.testing.assert_array_equal(file.pose_ids, ids)
    # the prior's information is turned there and back: rounding
    assert file.graph.chi2() == pytest.approx(graph.chi2(), rel=1e-12)
    np.testing.assert_allclose(file.graph.pose_priors.information[0], A, rtol=1e-14)


def test_poses_without_vertex_lines_start_from_the_edges(tmp_path):
    file = read_graph(write(tmp_path, 'EDGE_SE2 3 4 1 0 0 1 0 0 1 0 1\n'))
    assert list(file.pose_ids) == [3, 4]
    np.testing.assert_array_equal(file.graph.poses, [[0, 0, 0], [1, 0, 0]])


@pytest.mark.parametrize(
    ('text', 'match'),
    [
        ('', 'no vertices and no edges'),
        ('VERTEX_SE2 0 0 0\n', r':1: VERTEX_SE2 has 3 values instead of 4'),
        ('VERTEX_SE2 0 0 0 zero\n', r':1: could not convert'),
        ('VERTEX_SE2 0 0 0 nan\n', r':1: a value is not finite'),
        ('VERTEX_SE2 a 0 0 0\n', r':1: bad vertex id'),
        ('VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 0 0 0\n', r':2: vertex 0 is declared twice'),
        (G2O + 'FIX 77\n', r':12: FIX of unknown vertex 77'),
        (G2O + 'EDGE_SE2 10 12 1 0 0 1 0 0 1 0 1\n', r':12: unknown vertex 12'),
        (G2O + 'EDGE_SE2 10 10 1 0 0 1 0 0 1 0 1\n', r':12: both ends'),
        (G2O + 'EDGE_SE2 10 11 1 0 0 1 0 0 -1 0 1\n', r':12: information is not positive'),
        (G2O + 'VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n', r':12: VERTEX_SE3:QUAT is not a 2D'),
        ('1 2 3\n', r":1: '1 2 3' is no g2o"),
    ],
)
def test_malformed_file_is_refused_by_line(tmp_path, text, match):
    with pytest.raises(FileFormatError, match=match):
        read_graph(write(tmp_path, text))


def test_file_that_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(FileFormatError, match='cannot be read'):
        read_graph(tmp_path / 'none.g2o')
    (tmp_path / 'cut.g2o.gz').write_bytes(gzip.compress(G2O.encode())[:-20])
    with pytest.raises(FileFormatError, match='cannot be read'):
        read_graph(tmp_path / 'cut.g2o.gz')
    (tmp_path / 'binary.g2o').write_bytes(b'\xff\xfe\x00')
    with pytest.raises(FileFormatError, match='which is ASCII: byte 0 is not'):
        read_graph(tmp_path / 'binary.g2o')


def test_toro_refuses_landmarks(tmp_path):
    graph = Graph()
    graph.add_landmark([0, 0])
    with pytest.raises(FileFormatError, match='TORO holds poses and edges alone'):
        write_graph(tmp_path / 'a.graph', graph)
