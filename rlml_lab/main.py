# SPDX-License-Identifier: Apache-2.0
"""The command ``rlml-lab``: studies, benchmarks and work over many bags, run from a checkout.

They are not part of what a robot installs; ``make env`` puts the command into ``.venv/bin``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rlml_slam.cli import main as command_line
from rlml_slam.cli.main import Command, Group, Table

COMMANDS: Table = {
    'study': Group(
        'experiments that answer one question each',
        {
            'front-end': Command(
                'rlml_lab.studies.study_front_end',
                'each sensor alone and together, faults, kidnapping',
            ),
            'worlds': Command(
                'rlml_lab.studies.study_worlds', 'accuracy and consistency over seeds and worlds'
            ),
            'drift': Command(
                'rlml_lab.faults.study_drift',
                'growth of the heading error by distance, against its sigma',
            ),
            'faults': Command(
                'rlml_lab.faults.study_faults',
                'faults put into a recording: error, health and cost of each',
            ),
            'stalls': Command(
                'rlml_lab.faults.study_stalls',
                'odometry that stands still while the robot drives, then catches up',
            ),
            'fleet': Command(
                'rlml_lab.fleet_studies.study_fleet',
                'many replays on a cluster: the same, faster, through kills, and what they find',
            ),
            'sweep': Command(
                'rlml_lab.fleet_studies.study_sweep',
                'what values of parameters change, over many bags',
            ),
            'lifelong': Command(
                'rlml_lab.studies.study_lifelong',
                'hours in one hall: size of the map and cost of a keyframe',
            ),
            'deformable': Command(
                'rlml_lab.deformable.study_deformable',
                'deformable-feature SLAM: EKF against NLS over many seeds',
            ),
            'ekf': Command(
                'rlml_lab.ekf.study_ekf',
                'RLML, the EKF with each extractor and dead reckoning on the same drives',
            ),
            'audit': Command(
                'rlml_lab.layout.study_audit',
                'whether an audit finds moved, hidden, dirty and mirrored reflectors',
            ),
            'relocalization': Command(
                'rlml_lab.studies.study_relocalization',
                'whether reflectors alone give the pose, and whether the answer is right',
            ),
            'building': Command(
                'rlml_lab.studies.study_building',
                'large loops in made buildings: whether each closure is right',
            ),
            'lego': Command(
                'rlml_lab.lego.study_lego',
                'spikes and EKF on the LEGO robot among cylinders: figures and a picture',
            ),
            'repeatability': Command(
                'rlml_lab.studies.study_repeatability',
                'how often spikes and lines of a corrected log are seen again',
            ),
            'closures': Command(
                'rlml_lab.studies.study_closures',
                'whether the loop closures of a log are right, by its relations',
            ),
            'detector': Command(
                'rlml_lab.studies.study_detector',
                'bias, false detections and reach of the reflector detector',
            ),
            'store': Command(
                'rlml_lab.studies.study_store',
                'map files that are cut off, flipped, or killed while saved',
            ),
            'view': Command('rlml_lab.live.study_view', 'cost and latency of the live viewer'),
            'incidents': Command(
                'rlml_lab.live.study_incidents', 'kidnapped robots and their black boxes'
            ),
            'lifecycle': Command(
                'rlml_lab.live.study_lifecycle', 'transitions at random instants, over DDS'
            ),
            'tf-now': Command(
                'rlml_lab.dropin.study_tf_now', "tf2's own buffer asks where the robot is now"
            ),
            'shadow': Command(
                'rlml_lab.dropin.study_shadow', 'in shadow mode beside another localization, live'
            ),
            'tf-only': Command(
                'rlml_lab.dropin.study_tf_only', 'bags as robots record, against topics'
            ),
            'nav2-maps': Command(
                'rlml_lab.dropin.study_nav2_maps', 'localization by the size of a cell'
            ),
            'site': Command(
                'rlml_lab.site.study_site', 'many sessions of a large site become one map'
            ),
            'live-load': Command(
                'rlml_lab.live.study_live_load',
                'load a map while driving, over DDS',
            ),
            'contact': Command(
                'rlml_lab.contact.study_contact',
                'messages that nobody should send: nodes go on, poses too',
            ),
            'starved': Command(
                'rlml_lab.contact.study_starved',
                'mutated messages beside a node that often has no processor',
            ),
            'fuzz-files': Command(
                'rlml_lab.contact.study_fuzz_files', 'mutated files of every format that is read'
            ),
            'broken-bags': Command(
                'rlml_lab.contact.study_broken_bags',
                'what can be read of bags that are cut off or damaged',
            ),
            'kills': Command(
                'rlml_lab.contact.study_kills', 'processes that are killed while they map, live'
            ),
            'plan-bound': Command(
                'rlml_lab.layout.study_plan_bound',
                'errors of the reflector term against the planned sigma, area by area',
            ),
            'plan-real': Command(
                'rlml_lab.layout.study_plan_real',
                'plans of real layouts beside what recorded runs show, area by area',
            ),
            'plan-verdicts': Command(
                'rlml_lab.layout.study_plan_verdicts',
                'whether places that are planned unique are answered right',
            ),
            'plan-suggest': Command(
                'rlml_lab.layout.study_plan_suggest',
                'suggested reflectors against exhaustive search, and drives through layouts',
            ),
            'mrclam': Command(
                'rlml_lab.studies.study_mrclam',
                'maps from MR.CLAM, with known ids and without',
            ),
            'victoria-park': Command(
                'rlml_lab.studies.study_victoria_park',
                'dead reckoning, EKF and RLML among trees, against GPS',
            ),
        },
    ),
    'fleet': Group(
        'many bags at once, on this machine or a cluster',
        {
            'replay': Command(
                'rlml_lab.fleet.fleet_replay',
                'many bags through the system, against the run before',
            ),
        },
    ),
    'convert': Command('rlml_lab.datasets.convert', 'public data sets become bags'),
    'pictures': Command(
        'rlml_lab.live.pictures', 'the pictures of the documentation, by Chromium'
    ),
    'results': Command('rlml_lab.results', 'the page of benchmarks, from docs/benchmarks.json'),
    'bench': Group(
        'measured speed and quality against other libraries',
        {
            'back-end': Command(
                'rlml_lab.bench.bench_back_end', 'the graph solver against other libraries'
            ),
            'front-end': Command(
                'rlml_lab.bench.bench_front_end', 'CPU time per scan against a scan matcher'
            ),
            'incremental': Command(
                'rlml_lab.bench.bench_incremental', 'the incremental solver against iSAM2'
            ),
            'marginals': Command('rlml_lab.bench.bench_marginals', 'covariances against GTSAM'),
            'robust': Command(
                'rlml_lab.bench.bench_robust', 'wrong closures in graphs, against GTSAM'
            ),
            'search': Command(
                'rlml_lab.bench.bench_search', 'global searches by scan in a large building'
            ),
            'live': Command(
                'rlml_lab.bench.bench_live', 'whether the live nodes keep up with a fast laser'
            ),
        },
    ),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line of ``rlml-lab``; the exit code."""
    return command_line.main(
        argv,
        COMMANDS,
        'rlml-lab',
        'Studies, benchmarks and work over many bags of rlml_slam, for its developers.',
    )


if __name__ == '__main__':
    sys.exit(main())
