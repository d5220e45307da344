# SPDX-License-Identifier: Apache-2.0
"""Frames, topics, files and timing of the nodes; the bag that bag_player plays."""

from __future__ import annotations

from dataclasses import dataclass, field

from rlml_slam.params.declaration import Group, param


@dataclass(frozen=True)
class Node(Group, prefix=''):
    """Frames, topics, files and timing of a node; names follow slam_toolbox."""

    map_frame: str = param('map', 'frame of the map')
    odom_frame: str = param('odom', 'frame of the raw odometry')
    base_frame: str = param(
        'base_link', 'frame of the robot; all estimates are poses of this frame'
    )
    local_frame: str = param(
        'rlml_local', 'frame in which the front end estimates: no jumps when the map is corrected'
    )
    scan_topic: str = param('scan', 'LaserScan topic')
    scan_topics: tuple[str, ...] = param(
        ('',), 'LaserScan topics of several lidars; replaces scan_topic'
    )
    odom_topic: str = param('odom', 'Odometry topic')
    odom_source: str = param(
        'auto',
        'where odometry is read: the transform odom_frame to base_frame on /tf, odom_topic, or '
        'the first of the two that is there',
        choices=('auto', 'tf', 'topic'),
    )
    provide_odom_frame: bool = param(
        False, 'without odometry: publish odom_frame to base_frame on /tf, from the scans'
    )
    imu_topic: str = param('imu', 'Imu topic')
    reflectors_topic: str = param('reflectors', 'PointCloud2 topic of reflector detections')
    reflector_poses_topic: str = param(
        'reflector_poses', 'PoseArray topic of reflector detections'
    )
    reflector_markers_topic: str = param(
        'nav_reflectors', 'MarkerArray topic of reflector detections, of sick_scan_xd (NAV350)'
    )
    reflector_beams_topic: str = param(
        'extended_laser_scan',
        'ExtendedLaserScan topic of sick_safetyscanners2 (nanoScan3): its reflector bit',
    )
    landmarks_topic: str = param(
        'landmark', 'LandmarkList topic, as Cartographer has it, where cartographer_ros_msgs is'
    )
    max_beams: int = param(20_000, 'a scan with more beams is refused', '', 10, 1_000_000)
    max_reflectors: int = param(
        500,
        'a message with more reflectors is refused: it is something else, such as a 3D lidar',
        '',
        1,
        10_000,
    )
    trust_ids: bool = param(
        False, 'ids 0, 1, 2 … are used even before a message shows that they do not count its rows'
    )
    use_odom: bool = param(True, 'use odometry; false: constant-velocity model')
    use_imu: bool = param(True, 'use the yaw rate of the IMU, if there is one')
    filter_stamps: bool = param(
        True, 'remove the jitter of the stamps of sensors with a constant rate'
    )
    estimate_odometry_delay: bool = param(
        True, 'correct the stamps of odometry by how late they are against scans and reflectors'
    )
    leave_out_robot_parts: bool = param(
        True, 'leave out beams that see the robot itself: their range stays the same as it moves'
    )
    use_scan: bool = param(True, 'match scans against the submap')
    use_reflectors: bool = param(True, 'use reflector detections')
    detect_reflectors: str = param(
        'auto',
        'detect reflectors in the intensities of the scans: where no topic brings them and '
        'something is far brighter than all that is diffuse; always, by detector.*; never',
        choices=('auto', 'on', 'off'),
    )
    autostart: bool = param(
        True, 'become active at start; false: a lifecycle manager does it, such as that of nav2'
    )
    mode: str = param(
        'mapping', 'build a map, or localize in a saved one', choices=('mapping', 'localization')
    )
    map_directory: str = param('maps', 'the only folder that maps are saved to and loaded from')
    map_file_name: str = param(
        'map',
        'name of the saved map in map_directory, without suffix; NAME.yaml is a map of nav2',
        live=True,
    )
    continue_map: bool = param(
        False,
        'mapping: at start, load map_file_name.rlml or a younger autosave of it, and extend it',
    )
    journal_period: float = param(
        5.0,
        'mapping: period at which new frames are written to a journal in map_directory, from '
        'which the map is recovered where the process was killed; 0: no journal',
        's',
        0.0,
        60.0,
    )
    map_start_pose: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), 'start pose in the saved map', 'm, m, rad'
    )
    map_start_sigma: tuple[float, ...] = param(
        (0.5, 0.5, 0.26),
        'error of map_start_pose in a saved map, 1 sigma; as a pose set in RViz',
        'm, m, rad',
        0.0,
        100.0,
    )
    restore_pose: bool = param(
        True,
        'start in a saved map at the last pose of the robot, if scan and reflectors match there',
    )
    laser_pose: tuple[float, ...] = param(
        (0.0, 0.0, 0.0),
        'pose of the laser in base_frame, if /tf_static does not have it',
        'm, m, rad',
    )
    laser_upside_down: bool = param(
        False, 'the laser is mounted upside down at laser_pose, if /tf_static does not have it'
    )
    tf_broadcast: bool = param(True, 'publish map_frame to odom_frame on /tf; as AMCL')
    transform_publish_period: float = param(
        0.02,
        'period at which map_frame to odom_frame is repeated on /tf; 0: it is never published, as '
        'with slam_toolbox',
        's',
        0.0,
        10.0,
        live=True,
    )
    transform_tolerance: float = param(
        0.5,
        'time by which map_frame to odom_frame is dated ahead on /tf, as AMCL does; 0: it has the '
        'stamp of its scan',
        's',
        0.0,
        10.0,
    )
    shadow: bool = param(
        False,
        'run beside another localization: nothing on /tf, and every topic that others may have is '
        'below shadow/',
    )
    odom_timeout: float = param(
        0.2, 'longest time that a scan waits for the odometry at its stamp', 's', 0.0, 10.0
    )
    map_update_interval: float = param(
        2.0, 'period at which map, graph and trajectory are published', 's', 0.05, 600.0, live=True
    )
    tf_buffer_duration: float = param(
        30.0, 'length of the buffers of odometry and of waiting inputs', 's', 1.0, 600.0
    )


@dataclass(frozen=True)
class Incident(Group, prefix='incident.'):
    """The black box of the front end: what it keeps, and when it writes."""

    record: bool = param(
        True, 'write what came before and after the robot is LOST, DEGRADED for long, or jumps'
    )
    before: float = param(60.0, 'time before an incident that is written', 's', 1.0, 600.0)
    after: float = param(10.0, 'time after it that is written', 's', 0.0, 60.0)
    degraded_time: float = param(30.0, 'DEGRADED for longer is an incident', 's', 1.0, 3600.0)
    min_period: float = param(
        60.0, 'between two incidents, unless a user asks for one', 's', 0.0, 86_400.0
    )
    max_memory: float = param(
        64.0, 'of the messages kept; beyond it, less time is kept', 'MB', 1.0, 4000.0
    )
    max_disk: float = param(
        500.0,
        'of all incidents in map_directory/incidents; the oldest are removed',
        'MB',
        1.0,
        1e6,
    )


@dataclass(frozen=True)
class Player(Group, prefix=''):
    """The bag that bag_player publishes, and at which rate."""

    bag: str = param('', 'rosbag2 folder (sqlite3 or mcap), .mcap, .db3 or ROS 1 .bag')
    rate: float = param(1.0, 'playback rate: recorded seconds per second', '', 0.01, 1000.0)
    clock_rate: float = param(100.0, 'rate of /clock in recorded time', 'Hz', 1.0, 1e4)
    wait_for_subscribers: int = param(
        0, 'playback starts when a topic has this many subscribers', '', 0, 100
    )
    wait_for_topic: str = param('', 'topic whose subscribers are counted; empty: any of the bag')
    start_delay: float = param(1.0, 'delay before playback starts, for discovery', 's', 0.0, 600.0)


@dataclass(frozen=True)
class PlayerParameters:
    """Parameters of bag_player."""

    node: Player = field(default_factory=Player)
