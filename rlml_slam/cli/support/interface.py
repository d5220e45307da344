# SPDX-License-Identifier: Apache-2.0
"""What the nodes offer, as data: docs/topics.md is made of it, and tests hold it to the code."""

from __future__ import annotations

from dataclasses import dataclass

IN, OUT = 'sub', 'pub'
SENSOR, RELIABLE, LATCHED = 'best effort', 'reliable', 'reliable, transient local'
POSE = 'geometry_msgs/PoseWithCovarianceStamped'
CLOUD = 'sensor_msgs/PointCloud2'
STATUS = 'diagnostic_msgs/DiagnosticStatus'
TF = 'tf2_msgs/TFMessage'
ODOM_TF = 'odometry, as `odom_frame` to `base_frame`; sensors that have their place here'
MARKERS = 'visualization_msgs/MarkerArray'


@dataclass(frozen=True)
class Topic:
    """A topic of a node; its relative ``name`` is that of ``parameter``, where there is one."""

    node: str
    direction: str
    name: str
    type: str
    qos: str
    meaning: str
    parameter: str = ''


@dataclass(frozen=True)
class Service:
    """A service of a node; ``~`` is the node's name."""

    node: str
    name: str
    type: str
    meaning: str


TOPICS = (
    Topic('front_end', IN, 'scan', 'sensor_msgs/LaserScan', SENSOR,
          'sweeps, stamped with the first ray; NaN, Inf and any number of beams are fine',
          'scan_topic'),
    Topic('front_end', IN, 'odom', 'nav_msgs/Odometry', SENSOR,
          'wheel odometry; only the increments of its pose are used', 'odom_topic'),
    Topic('front_end', IN, 'imu', 'sensor_msgs/Imu', SENSOR,
          'yaw rate; its bias is estimated', 'imu_topic'),
    Topic('front_end', IN, 'reflectors', CLOUD, SENSOR,
          'detections: `x`, `y`; optional `id` (-1 is anonymous), `sigma_range`, '
          '`sigma_bearing`, `diameter`. An empty cloud says "looked and saw none"',
          'reflectors_topic'),
    Topic('front_end', IN, 'reflector_poses', 'geometry_msgs/PoseArray', SENSOR,
          'the same in its simplest form', 'reflector_poses_topic'),
    Topic('front_end', IN, 'nav_reflectors', 'visualization_msgs/MarkerArray', SENSOR,
          'the same as cylinders, of a NAV350 by sick_scan_xd', 'reflector_markers_topic'),
    Topic('front_end', IN, 'initialpose', POSE, RELIABLE, 'restart at this pose of the map'),
    Topic('front_end', IN, 'rlml/graph_correction', CLOUD, RELIABLE,
          'of the back end: the local frame in the map, and the newest pose and the reflectors '
          'as the graph has them'),
    Topic('front_end', IN, 'rlml/session_start', CLOUD, RELIABLE,
          'of the back end: where the robot was found; begin a session there, or go on from '
          'there'),
    Topic('front_end', IN, 'rlml/localization_map', CLOUD, LATCHED,
          'of the back end: reflectors to localize in; a cloud without fields ends it'),
    Topic('front_end', IN, 'rlml/localization_grid', 'nav_msgs/OccupancyGrid', LATCHED,
          'of the back end: the grid of that map, for the scans'),
    Topic('front_end', IN, 'rlml/map_entry', 'std_msgs/String', LATCHED,
          'of the back end: why poses are not in the map that is to be continued; empty where '
          'they are'),
    Topic('front_end', IN, '/tf', TF, SENSOR, ODOM_TF),
    Topic('front_end', IN, '/tf_static', 'tf2_msgs/TFMessage', LATCHED, 'where the sensors sit'),
    Topic('front_end', OUT, 'pose', POSE, RELIABLE,
          'pose in the map with covariance, one per scan, stamped as the scan'),
    Topic('front_end', OUT, '~/odometry', 'nav_msgs/Odometry', RELIABLE,
          'pose in a continuous local frame, with twist and covariances'),
    Topic('front_end', OUT, 'rlml/frames', CLOUD, RELIABLE,
          'for the back end: all figures of a frame'),
    Topic('front_end', OUT, 'deskewed_points', CLOUD, RELIABLE,
          'end points of the scan in the base frame, motion taken out'),
    Topic('front_end', OUT, 'reflectors/associated', CLOUD, RELIABLE,
          'detections with the reflector that each was taken for'),
    Topic('front_end', OUT, 'reflectors/statuses', MARKERS, RELIABLE,
          'the same in colours: used green, gated red, new blue, ghost grey, ambiguous yellow, '
          'deferred violet'),
    Topic('front_end', OUT, '~/health', STATUS, LATCHED,
          'OK, DEGRADED or LOST with reasons, with every frame and at once on a change'),
    Topic('front_end', OUT, '/diagnostics', 'diagnostic_msgs/DiagnosticArray', RELIABLE,
          '1 Hz: OK, DEGRADED or LOST with reasons; what became of the inputs'),
    Topic('back_end', IN, 'rlml/frames', CLOUD, RELIABLE, 'of the front end'),
    Topic('back_end', IN, 'deskewed_points', CLOUD, RELIABLE, 'of the front end'),
    Topic('back_end', IN, 'reflectors/associated', CLOUD, RELIABLE, 'of the front end'),
    Topic('back_end', OUT, 'correction', POSE, LATCHED,
          "while a map is made: the front end's local frame in the map; the covariance is its "
          "pose's there"),
    Topic('back_end', OUT, 'rlml/graph_correction', CLOUD, RELIABLE,
          'for the front end: the correction, and the newest pose and the reflectors as the '
          'graph has them'),
    Topic('back_end', OUT, 'rlml/session_start', CLOUD, RELIABLE,
          'for the front end: where the robot was found, after a loss or in a map that was '
          'loaded, and where to begin after a reset'),
    Topic('back_end', OUT, 'rlml/localization_map', CLOUD, LATCHED,
          'for the front end: reflectors to localize in; the stamp is a number'),
    Topic('back_end', OUT, 'rlml/localization_grid', 'nav_msgs/OccupancyGrid', LATCHED,
          'for the front end: the grid of that map; the stamp is a number'),
    Topic('back_end', OUT, 'rlml/map_entry', 'std_msgs/String', LATCHED,
          'for the front end: why poses are not in the map that is to be continued'),
    Topic('back_end', OUT, 'updates', CLOUD, RELIABLE,
          'what each keyframe cost, and the loop closures that it brought'),
    Topic('back_end', OUT, '/tf', 'tf2_msgs/TFMessage', RELIABLE,
          'map to odom only; without tf2_msgs on `~/map_to_odom` (TransformStamped)'),
    Topic('back_end', OUT, 'jumps', POSE, RELIABLE,
          'where a correction puts the robot, as seen from where it was believed (`base_frame`)'),
    Topic('back_end', OUT, 'map', 'nav_msgs/OccupancyGrid', LATCHED, 'the map of the scans'),
    Topic('back_end', OUT, 'map_metadata', 'nav_msgs/MapMetaData', LATCHED, 'its size and place'),
    Topic('back_end', OUT, 'trajectory', 'nav_msgs/Path', LATCHED,
          'while a map is made: the optimised path, a pose per scan'),
    Topic('back_end', OUT, 'reflector_map', MARKERS, LATCHED, 'reflectors with 95 % ellipses'),
    Topic('back_end', OUT, 'reflector_map_points', CLOUD, LATCHED,
          'reflectors with covariance, id, number of sightings'),
    Topic('back_end', OUT, 'graph', MARKERS, LATCHED,
          'while a map is made: keyframes, and edges by kind'),
    Topic('back_end', OUT, '~/health', STATUS, LATCHED, 'health of the newest frame'),
    Topic('back_end', OUT, '/diagnostics', 'diagnostic_msgs/DiagnosticArray', RELIABLE,
          '1 Hz: size of the graph, frames that wait'),
    Topic('reflector_detector', IN, 'scan', 'sensor_msgs/LaserScan', SENSOR,
          'sweeps with intensities, from 90 to 7200 beams', 'scan_topic'),
    Topic('reflector_detector', IN, 'odom', 'nav_msgs/Odometry', SENSOR,
          'takes out the motion during a sweep', 'odom_topic'),
    Topic('reflector_detector', IN, 'imu', 'sensor_msgs/Imu', SENSOR, 'the same', 'imu_topic'),
    Topic('reflector_detector', IN, '/tf', TF, SENSOR, ODOM_TF),
    Topic('reflector_detector', IN, '/tf_static', 'tf2_msgs/TFMessage', LATCHED,
          'where the lasers sit'),
    Topic('reflector_detector', OUT, 'reflectors', CLOUD, SENSOR,
          'one cloud per scan, in its frame and at its stamp: `x`, `y`, `id` (-1), `sigma_range`, '
          '`sigma_bearing`, `diameter` (NaN is flat), `intensity`; empty where none is seen',
          'reflectors_topic'),
    Topic('reflector_detector', OUT, '/diagnostics', 'diagnostic_msgs/DiagnosticArray', RELIABLE,
          '1 Hz: reflectors found, bright spots rejected by reason'),
    Topic('simulator', IN, 'cmd_vel', 'geometry_msgs/Twist', RELIABLE, 'with `drive:=cmd_vel`'),
    Topic('simulator', OUT, 'scan', 'sensor_msgs/LaserScan', SENSOR,
          'with intensities and time per ray'),
    Topic('simulator', OUT, 'odom', 'nav_msgs/Odometry', RELIABLE, 'wheel odometry'),
    Topic('simulator', OUT, 'imu', 'sensor_msgs/Imu', SENSOR, 'yaw rate with a bias'),
    Topic('simulator', OUT, 'reflectors', CLOUD, SENSOR, 'detections, anonymous by default'),
    Topic('simulator', OUT, 'ground_truth', 'nav_msgs/Odometry', RELIABLE, 'true pose in the map'),
    Topic('simulator', OUT, 'ground_truth_reflectors', CLOUD, LATCHED,
          'true places of the reflectors'),
    Topic('simulator', OUT, '/diagnostics', 'diagnostic_msgs/DiagnosticArray', RELIABLE,
          '1 Hz: how many messages were published'),
    Topic('simulator', OUT, '/clock', 'rosgraph_msgs/Clock', RELIABLE, 'simulated time'),
    Topic('simulator', OUT, '/tf_static', 'tf2_msgs/TFMessage', LATCHED, 'base_link to laser'),
    Topic('deformable_slam', IN, 'odom', 'nav_msgs/Odometry', SENSOR, 'as front_end',
          'odom_topic'),
    Topic('deformable_slam', IN, 'imu', 'sensor_msgs/Imu', SENSOR, 'as front_end', 'imu_topic'),
    Topic('deformable_slam', IN, 'reflectors', CLOUD, SENSOR,
          'features of the carrier, by `id` or anonymous; fields as of front_end',
          'reflectors_topic'),
    Topic('deformable_slam', IN, 'reflector_poses', 'geometry_msgs/PoseArray', SENSOR,
          'the same in its simplest form', 'reflector_poses_topic'),
    Topic('deformable_slam', IN, 'nav_reflectors', 'visualization_msgs/MarkerArray', SENSOR,
          'the same as cylinders, of a NAV350 by sick_scan_xd', 'reflector_markers_topic'),
    Topic('deformable_slam', IN, 'carrier_velocity', 'geometry_msgs/TwistStamped', SENSOR,
          "the carrier's nominal velocity from the stamp on, in the axes of the map (or no "
          'frame) or of the base'),
    Topic('deformable_slam', IN, 'initialpose', POSE, RELIABLE, 'start again at this pose'),
    Topic('deformable_slam', IN, '/tf', TF, SENSOR, ODOM_TF),
    Topic('deformable_slam', IN, '/tf_static', 'tf2_msgs/TFMessage', LATCHED,
          'where the sensors sit'),
    Topic('deformable_slam', OUT, 'pose', POSE, RELIABLE,
          'pose in the map with covariance, one per detections, with their stamp'),
    Topic('deformable_slam', OUT, 'features', CLOUD, RELIABLE,
          'positions with `cov_xx`, `cov_xy`, `cov_yy`, `key` (never reused) and `id`'),
    Topic('deformable_slam', OUT, 'markers', MARKERS, RELIABLE, 'features with 95 % ellipses'),
    Topic('deformable_slam', OUT, 'cmd_vel_suggested', 'geometry_msgs/Twist', RELIABLE,
          'how to see the features best; only with `deformable.suggest`'),
    Topic('deformable_slam', OUT, '~/health', STATUS, LATCHED, 'as front_end'),
    Topic('deformable_slam', OUT, '/diagnostics', 'diagnostic_msgs/DiagnosticArray', RELIABLE,
          '1 Hz: health with reasons, inputs, p99 of the time per update'),
)  # fmt: skip

SERVICES = (
    Service('front_end', '~/save_incident', 'std_srvs/Trigger',
            'write the last minute of inputs and outputs, and what comes in the next seconds'),
    Service('back_end', '~/save_map', 'std_srvs/Trigger',
            'write `map_directory`/`map_file_name`: everything as `.rlml`, reflectors and grid'),
    Service('back_end', '~/load_map', 'nav_msgs/LoadMap',
            'localize in another map of `map_directory`, or while mapping go on with it; where it '
            'is refused, `map.header.frame_id` of the answer says why'),
    Service('back_end', '~/reset', 'std_srvs/Trigger',
            'begin at `map_start_pose`: in a new map, or, where it localizes, in the same'),
    Service('back_end', '~/closures', 'std_srvs/Trigger',
            'all loop closures: why each was accepted, its residual and weight, its state'),
    Service('back_end', '~/reflectors', 'std_srvs/Trigger',
            'what has become of each reflector: present, new, moved, missing or a ghost'),
    Service('back_end', '~/revoke_closure', 'diagnostic_msgs/AddDiagnostics',
            'take a loop closure out of the map; `load_namespace` is its number'),
    Service('back_end', '~/dynamic_map', 'nav_msgs/GetMap', 'the grid as it is now'),
    Service('back_end', '~/relocalize', 'std_srvs/Trigger',
            'find the newest reflectors and scan anywhere in the map, and while localizing go on '
            'from there; says so where they fit nowhere or in several places'),
    Service('back_end', 'reinitialize_global_localization', 'std_srvs/Empty',
            'the same; the answer goes to the log'),
    Service('back_end', '~/set_localization_mode', 'std_srvs/SetBool',
            'true: localize in the map as it is now; false: begin a new map from here'),
    Service('back_end', '~/pause_new_measurements', 'std_srvs/SetBool',
            'leave new measurements out of the map, or take them in again'),
)  # fmt: skip
