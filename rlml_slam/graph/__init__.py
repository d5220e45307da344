# SPDX-License-Identifier: Apache-2.0
"""Pose-landmark graphs and their solvers; other folders import from here alone.

A Graph is solved at once by ``optimize``, or keyframe by keyframe by an OnlineSolver.
"""

from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.batch.solver import Solution, optimize
from rlml_slam.graph.g2o import read_graph, write_graph
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model.factor_table import Column, FactorTable
from rlml_slam.graph.model.factors import (
    FactorKind,
    Losses,
    chi2,
    relative_information,
    relative_pose,
)
from rlml_slam.graph.model.graph import Graph, Renumbering
from rlml_slam.graph.model.robust_loss import Loss, LossKind
from rlml_slam.graph.model.robust_loss import weights as loss_weights
from rlml_slam.graph.reduction.edge_pruning import prune_edges, prune_sightings
from rlml_slam.graph.reduction.marginalization import (
    RelativePoses,
    floored_covariance,
    marginalize_pose,
)
from rlml_slam.graph.robust.closure_selection import Selection, select_closures
from rlml_slam.graph.robust.inlier_evidence import evidence, uniform
from rlml_slam.graph.robust.path_bound import path_bound

__all__ = [
    'Column', 'FactorKind', 'FactorTable', 'Graph', 'Loss', 'LossKind', 'Losses', 'Marginals',
    'OnlineSolver', 'RelativePoses', 'Renumbering', 'Selection', 'Solution', 'chi2', 'evidence',
    'floored_covariance', 'loss_weights', 'marginalize_pose', 'optimize', 'path_bound',
    'prune_edges', 'prune_sightings', 'read_graph', 'relative_information', 'relative_pose',
    'select_closures', 'uniform', 'write_graph',
]  # fmt: skip
