# SPDX-License-Identifier: Apache-2.0
"""Odometry, IMU, laser and reflector detector: what the true motion looks like to a robot.

Every source of randomness has a generator of its own, and draws the same amount whatever the
parameters are: turning one fault on leaves all other noise as it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.params import Gyro, Laser, Markers, Wheels
from rlml_slam.se2 import Array
from rlml_slam.sensing.polar import polar_covariance
from rlml_slam.simulation.ray_cast import cast
from rlml_slam.simulation.robot import SECOND, Track
from rlml_slam.simulation.world import GLOSS, REFLECTANCE, REFLECTOR, RETRO, Geometry, ReflectorSet
from rlml_slam.types import ANONYMOUS, Detections, Imu, Odometry, Scan

Generators = Callable[[str], np.random.Generator]
# brightness of a white wall met head on at 1 m, before the loss with range
WHITE = 1000.0
# echoes within this range of the strongest one melt into one echo (mixed pixels)
PULSE = 0.5
# share of a beam's power in its middle and its two edges
BEAM_PROFILE = np.array([0.25, 0.5, 0.25])
# half width of the bright spot of a glossy wall, as 1 - cos of the angle to its normal
GLOSS_LOBE = 0.004


class WheelSensor:
    """Odometry whose noise is that of eq. 6, with slip bursts and scale errors.

    Over an interval dt, travel has the variance (a |v| + b)^2 interval dt and the turn
    (c |omega| + d)^2 interval dt, so that the accumulated noise does not depend on the rate.
    A robot that stands still has wheels that stand still: no noise.
    """

    def __init__(self, wheels: Wheels, generators: Generators) -> None:
        self._n = wheels
        self._noise = generators('wheels')
        self._slip = generators('slip')
        self._slip_until = -1
        self._slip_v = self._slip_w = 0.0
        self._stamp: int | None = None
        self._pose = np.zeros(3)

    def measure(self, track: Track, stamp: int) -> Odometry:
        """The odometry at a stamp not before that of the call before."""
        if self._stamp is not None and stamp > self._stamp:
            travel, turn = track.wheel_motion(self._stamp, stamp)
            dt = (stamp - self._stamp) / SECOND
            step = self._measured(travel, turn, dt, stamp)
            self._pose = se2.compose(self._pose, se2.exp(np.array([step[0], 0.0, step[1]])))
        self._stamp = stamp
        return Odometry(stamp, self._pose)

    def _measured(self, travel: float, turn: float, dt: float, stamp: int) -> tuple[float, float]:
        n = self._n
        e_v, e_w = self._noise.standard_normal(2)
        chance, share, rate = self._slip.random(), self._slip.random(), self._slip.normal()
        if travel == 0.0 and turn == 0.0:
            return 0.0, 0.0
        if chance < n.slip_rate * dt and stamp >= self._slip_until:
            self._slip_until = stamp + int(n.slip_duration * SECOND)
            self._slip_v, self._slip_w = n.slip_speed * share, n.slip_turn * rate
        v, w = travel / dt, turn / dt
        spread = math.sqrt(n.noise_interval * dt)
        measured_travel = (
            n.speed_scale * travel + (n.speed_noise * abs(v) + n.speed_noise_floor) * spread * e_v
        )
        measured_turn = (
            n.turn_scale * turn + (n.turn_noise * abs(w) + n.turn_noise_floor) * spread * e_w
        )
        if stamp < self._slip_until:
            measured_travel += self._slip_v * travel
            measured_turn += self._slip_w * dt
        return measured_travel, measured_turn


class GyroSensor:
    """Yaw rate with white noise of eq. 6 and a bias that walks.

    A sample stands for 1 / rate seconds: its variance is (c |omega| + d)^2 noise_interval rate.
    """

    def __init__(self, gyro: Gyro, generators: Generators) -> None:
        self._n = gyro
        self._noise = generators('gyro')
        self._walk = generators('bias')
        self.bias = gyro.bias

    def measure(self, track: Track, stamp: int) -> Imu:
        """The IMU at a stamp."""
        n = self._n
        rate = track.turn_rate(stamp)
        sigma = (n.turn_noise * abs(rate) + n.turn_noise_floor) * math.sqrt(
            n.noise_interval * n.rate
        )
        measured = rate + self.bias + sigma * self._noise.standard_normal()
        self.bias += n.bias_walk / math.sqrt(n.rate) * self._walk.standard_normal()
        return Imu(stamp, measured)


class LaserSensor:
    """A sweep of beams, each cast at its own time from where the laser is then."""

    def __init__(
        self, laser: Laser, T_base_laser: Array, frame_id: str, generators: Generators
    ) -> None:
        self._n = laser
        self.T_base_laser = T_base_laser
        self.frame_id = frame_id
        self._range = generators('range')
        self._dropped = generators('dropped')
        self._intensity = generators('intensity')
        whole = laser.field_of_view > 2.0 * math.pi - 1e-6
        self.increment = laser.field_of_view / (laser.beams if whole else laser.beams - 1)
        self.angle_min = -0.5 * laser.field_of_view
        turn_time = 1.0 / laser.rate
        self.ray_time = self.increment / (2.0 * math.pi) * turn_time if laser.ray_times else 0.0

    @property
    def sweep(self) -> int:
        """Time [ns] from the first ray to one after the last."""
        return round(self.ray_time * self._n.beams * SECOND)

    def poses(self, track: Track, stamps: NDArray[np.int64]) -> Array:
        """Poses (n, 3) of the laser in the world."""
        return se2.compose(track.poses(stamps), self.T_base_laser)

    def measure(self, track: Track, stamp: int, geometry: Geometry, moment: int) -> Scan:
        """The sweep that began at ``stamp``; ``geometry`` is that of the stamp ``moment``."""
        n = self._n
        k = np.arange(n.beams)
        stamps = stamp + np.rint(k * (self.ray_time * SECOND)).astype(np.int64)
        T_world_laser = self.poses(track, stamps)
        # the sweep turns less than half a turn: unwrapped headings keep the angles sorted
        first = T_world_laser[0, 2]
        heading = first + se2.wrap(T_world_laser[:, 2] - first)
        angles = heading + self.angle_min + k * self.increment
        half = 0.5 * n.divergence
        edges = np.array([-half, 0.0, half]) if half > 0.0 else np.zeros(1)
        hits = cast(
            np.repeat(T_world_laser[:, :2], len(edges), axis=0),
            (angles[:, None] + edges).ravel(),
            np.repeat((stamps - moment) / SECOND, len(edges)),
            geometry,
            n.range_max + PULSE,
        )
        ranges, power = self._echoes(*hits, geometry.surface, len(edges))
        return self._scan(stamp, ranges, power)

    def _echoes(
        self, ranges: Array, objects: NDArray[np.int64], cosines: Array, surface: Array, edges: int
    ) -> tuple[Array, Array]:
        """Range and received power (n,) of each beam of ``edges`` rays; Inf and 0 for none."""
        row = np.concatenate([surface, np.zeros((1, 4))])[objects]  # -1 is the last, all dark
        cosine = np.abs(cosines)
        power = row[:, REFLECTANCE] * (1.0 - 0.9 * row[:, GLOSS]) * cosine
        power += 20.0 * row[:, GLOSS] * np.exp((cosine - 1.0) / GLOSS_LOBE)
        # retro-reflectors work to about 75 degrees off their normal, and only at the front
        retro = (row[:, RETRO] > 0.0) & (cosines > 0.25)
        power[retro] = self._n.retro_gain * cosines[retro]
        power = WHITE * power.reshape(-1, edges)
        power *= BEAM_PROFILE if edges == 3 else 1.0
        ranges = ranges.reshape(-1, edges)
        with np.errstate(invalid='ignore'):
            strongest = np.take_along_axis(ranges, power.argmax(1)[:, None], 1)
            power = np.where(np.abs(ranges - strongest) <= PULSE, power, 0.0)
            total = power.sum(1)
            mean = np.where(power > 0.0, ranges * power, 0.0).sum(1) / total
        mean[total == 0.0] = np.inf
        return mean, total / (1.0 + (mean / self._n.gain_range) ** 2)

    def _scan(self, stamp: int, ranges: Array, power: Array) -> Scan:
        """Noise, limits and lost beams."""
        n = self._n
        ranges = ranges + n.range_sigma * self._range.standard_normal(n.beams)
        noise = n.intensity_noise * self._intensity.standard_normal(n.beams)
        power = power * np.maximum(1.0 + noise, 0.0)
        none = (power < n.min_intensity) | (ranges > n.range_max)
        power[none], ranges[none] = 0.0, np.inf
        ranges[ranges < n.range_min] = -np.inf
        lost = self._dropped.random(n.beams) < n.dropout_share
        power[lost], ranges[lost] = 0.0, np.nan
        return Scan(
            stamp,
            self.frame_id,
            self.angle_min,
            self.increment,
            self.ray_time,
            n.range_min,
            n.range_max,
            ranges.astype(np.float32),
            power.astype(np.float32),
        )


class MarkerSensor:
    """The reflectors that a scan saw: centres, in the laser frame at the stamp of the scan.

    A reflector is seen at the time when the beam sweeps over it, if then nothing stands between
    the laser and its middle; its position is moved to the stamp with the true motion.
    """

    def __init__(self, markers: Markers, reflectors: ReflectorSet, generators: Generators) -> None:
        self._n = markers
        self.reflectors = reflectors
        self._noise = generators('markers')
        self._missing = generators('missing')
        self._ghosts = generators('ghosts')

    def measure(
        self, track: Track, laser: LaserSensor, stamp: int, geometry: Geometry, moment: int
    ) -> Detections:
        """The detections of the sweep that began at ``stamp``."""
        n, m = self._n, len(self.reflectors)
        noise = self._noise.standard_normal((m, 2))
        missing = self._missing.random(m) < n.missed_share
        seen = np.flatnonzero(self._visible(track, laser, stamp, geometry, moment) & ~missing)
        T_world_laser = laser.poses(track, np.array([stamp]))[0]
        p = se2.transform(se2.inverse(T_world_laser), self.reflectors.points[seen])
        r = np.hypot(p[:, 0], p[:, 1]) + n.sigma_range * noise[seen, 0]
        bearing = np.arctan2(p[:, 1], p[:, 0]) + n.sigma_bearing * noise[seen, 1]
        ghost_r, ghost_bearing = self._false(laser)
        r, bearing = np.concatenate([r, ghost_r]), np.concatenate([bearing, ghost_bearing])
        u = np.stack([np.cos(bearing), np.sin(bearing)], -1)
        g = len(ghost_r)
        ids = self.reflectors.ids[seen] if n.ids else np.full(len(seen), ANONYMOUS)
        diameters = np.where(np.isnan(self.reflectors.normals), self.reflectors.widths, np.nan)[
            seen
        ]
        return Detections(
            stamp,
            laser.frame_id,
            r[:, None] * u,
            polar_covariance(u, n.sigma_range**2, (r * n.sigma_bearing) ** 2),
            np.concatenate([ids, np.full(g, ANONYMOUS)]).astype(np.int64),
            np.concatenate([diameters, np.full(g, np.nan)]),
        )

    def _false(self, laser: LaserSensor) -> tuple[Array, Array]:
        """Ranges and bearings of ghosts, uniform in range and bearing."""
        n = self._n
        g = int(self._ghosts.poisson(n.false_detections))
        u = self._ghosts.random((g, 2))
        return 0.5 + u[:, 0] * (n.max_range - 0.5), laser.angle_min * (1.0 - 2.0 * u[:, 1])

    def _visible(
        self, track: Track, laser: LaserSensor, stamp: int, geometry: Geometry, moment: int
    ) -> NDArray[np.bool_]:
        """Which reflectors (m,) the sweep met first."""
        points, m = self.reflectors.points, len(self.reflectors)
        span = laser.sweep / SECOND
        beams = span / laser.ray_time if laser.ray_time > 0.0 else 1.0
        at = np.full(m, stamp + laser.sweep // 2)
        for _ in range(2):  # when the beam meets it depends on where the laser is then
            T = laser.poses(track, at)
            dx, dy = points[:, 0] - T[:, 0], points[:, 1] - T[:, 1]
            bearing = se2.wrap(np.arctan2(dy, dx) - T[:, 2])
            share = (bearing - laser.angle_min) / (laser.increment * beams)
            at = stamp + np.rint(np.clip(share, 0.0, 1.0) * laser.sweep).astype(np.int64)
        inside = np.abs(bearing) <= -laser.angle_min + 1e-9
        near = np.hypot(dx, dy) <= self._n.max_range
        _, objects, cosines = cast(
            T[:, :2], np.arctan2(dy, dx), (at - moment) / SECOND, geometry, self._n.max_range + 1.0
        )
        met = np.concatenate([geometry.surface[:, REFLECTOR], [-1.0]])[objects]
        flat = ~np.isnan(self.reflectors.normals)
        facing = ~flat | (cosines >= math.cos(self._n.max_incidence))
        seen: NDArray[np.bool_] = (met == np.arange(m)) & facing & inside & near
        return seen
