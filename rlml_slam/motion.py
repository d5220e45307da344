# SPDX-License-Identifier: Apache-2.0
"""The motion model: odometry and IMU between two stamps become one relative pose and covariance.

The midpoint model of eq. 7 is applied per interval between two samples, and the intervals of a
scan are composed, so that curved motion and rates of any mix are right. Wheel odometry is
integrated on the robot: its pose after a gap tells the motion during it, whatever was lost.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.compiled import brief, part
from rlml_slam.params import MotionNoise
from rlml_slam.se2 import Array
from rlml_slam.types import Imu, Motion, Odometry

# [m^2], [rad^2] of a pose or a motion: from 1e9 or so, updates lose all their digits
MAX_VARIANCE = 1e6
SECOND = 1_000_000_000
Stamps = NDArray[np.int64]
# samples at least that are forgotten at once, and that are kept: what was before a gap is needed
# after it, however long that lasted
BATCH = 256
# of the speed at which floor and slope of the noise are equal: no robot drives slower for long
CREEP = 0.25
RECENT = 3.0  # [s] whose mean speed and turn rate are those of a long gap
ZERO = 0.05  # [m], [rad] from the pose at which odometry begins
COAST = 0.2  # [s] for which a robot is taken to go on as it went before its odometry ended
GYRO_GAP = 0.75  # [s] between turn rates: beyond it the wheels know better how far it turned
# Share of the noise of a slow motion that is left where the wheels do not turn: what they miss is
# less than a tick in all, and adds up to no walk. A larger one lets the noise of the first scan
# turn the whole map, while the robot stands and could well average it out.
STANDING = 0.02
# a robot moves sideways where it does so by this share of a way [m]; odometry of robots that
# cannot has up to .08 of half a metre in public logs, from rounding
ASIDE, WAY = 0.2, 0.5


@brief
def integrate(
    v: Array,
    w: Array,
    dt: Array,
    var_v: Array,
    var_w: Array,
    var_lat: Array,
    gyro: Array,
    lateral: Array,
) -> Array:
    """Compose control intervals (eq. 5, 7-9); all arguments ``(n,)``.

    Returns ``(7, 3)``: the relative pose in row 0 (theta not wrapped), its covariance in rows 1-3,
    its derivative by a bias of the turn rate in row 4 (``gyro`` is 1 where w is from the IMU), and
    in row 5 that by the share by which the wheels turn too little, where w is from them, and in
    row 6 that by the turn per distance [rad/m] that they do not measure.
    The sideways variance ``var_lat`` is that of a velocity across the heading, which the notes'
    (v, omega) cannot express and which keeps the covariance regular.
    """
    x = y = th = 0.0
    bx = by = bt = 0.0
    sx = sy = st = 0.0
    kx = ky = kt = 0.0
    P = np.zeros((3, 3))
    for k in range(len(v)):
        h = dt[k]
        c, s = math.cos(th + 0.5 * w[k] * h), math.sin(th + 0.5 * w[k] * h)
        dx, dy = h * (c * v[k] - s * lateral[k]), h * (s * v[k] + c * lateral[k])
        # G_x P G_x^T, eq. 8: only the heading column differs from the identity
        gx, gy = -dy, dx
        p02, p12, p22 = P[0, 2], P[1, 2], P[2, 2]
        P[0, 0] += 2.0 * gx * p02 + gx * gx * p22
        P[0, 1] += gx * p12 + gy * p02 + gx * gy * p22
        P[1, 1] += 2.0 * gy * p12 + gy * gy * p22
        P[0, 2] += gx * p22
        P[1, 2] += gy * p22
        # G_u Sigma_u G_u^T, eq. 9, with the sideways velocity as a third control
        ux, uy = h * c, h * s
        wx, wy = -0.5 * dy * h, 0.5 * dx * h
        P[0, 0] += ux * ux * var_v[k] + wx * wx * var_w[k] + uy * uy * var_lat[k]
        P[0, 1] += ux * uy * var_v[k] + wx * wy * var_w[k] - uy * ux * var_lat[k]
        P[1, 1] += uy * uy * var_v[k] + wy * wy * var_w[k] + ux * ux * var_lat[k]
        P[0, 2] += wx * h * var_w[k]
        P[1, 2] += wy * h * var_w[k]
        P[2, 2] += h * h * var_w[k]
        bx += gx * bt - gyro[k] * wx
        by += gy * bt - gyro[k] * wy
        bt -= gyro[k] * h
        more = (1.0 - gyro[k]) * w[k]
        sx += gx * st + more * wx
        sy += gy * st + more * wy
        st += more * h
        far = (1.0 - gyro[k]) * v[k]
        kx += gx * kt + far * wx
        ky += gy * kt + far * wy
        kt += far * h
        x += dx
        y += dy
        th += w[k] * h
    out = np.empty((7, 3))
    out[0, 0], out[0, 1], out[0, 2] = x, y, th
    out[1, 0], out[1, 1], out[1, 2] = P[0, 0], P[0, 1], P[0, 2]
    out[2, 0], out[2, 1], out[2, 2] = P[0, 1], P[1, 1], P[1, 2]
    out[3, 0], out[3, 1], out[3, 2] = P[0, 2], P[1, 2], P[2, 2]
    out[4, 0], out[4, 1], out[4, 2] = bx, by, bt
    out[5, 0], out[5, 1], out[5, 2] = sx, sy, st
    out[6, 0], out[6, 1], out[6, 2] = kx, ky, kt
    return out


def compose_motion(first: Motion, second: Motion) -> Motion:
    """Two motions, one after the other; their errors are independent."""
    if first is STILL:
        return second
    J_a, J_b = se2.compose_jacobians(first.delta, second.delta)
    cov = J_a @ first.cov @ J_a.T + J_b @ second.cov @ J_b.T
    bias_gain = J_a @ first.bias_gain + J_b @ second.bias_gain
    turn_gain = J_a @ first.turn_gain + J_b @ second.turn_gain
    drift_gain = J_a @ first.drift_gain + J_b @ second.drift_gain
    # what the two say of the bias, weighted; the weight of one that says nothing is zero
    weight = 1.0 / first.bias_var + 1.0 / second.bias_var
    var = 1.0 / weight if weight > 0.0 else math.inf
    w_a, w_b = (var / m.bias_var if weight > 0.0 else 0.0 for m in (first, second))
    return Motion(
        se2.compose(first.delta, second.delta),
        cov,
        first.known and second.known,
        bias_gain,
        w_a * first.bias + w_b * second.bias,
        var,
        turn_gain,
        w_a * first.bias_turn + w_b * second.bias_turn,
        drift_gain,
        w_a * first.bias_way + w_b * second.bias_way,
    )


STILL = Motion(np.zeros(3), np.zeros((3, 3)))


def motion_of(delta: Array, dt: float, noise: MotionNoise) -> Motion:
    """The motion that led to a relative pose ``delta`` (3,) in ``dt`` [s], by the wheels alone.

    Its covariance is that of one arc, in pieces of a control interval: what the heading errs by
    early moves the end.
    """
    n = max(math.ceil(dt / noise.noise_interval), 1)
    step = se2.log(delta)
    v, w = math.hypot(step[0], step[1]) / dt, step[2] / dt
    guess = noise.long_interval_noise if n > 2 else 0.0
    sigma = np.array([
        (noise.speed_noise + guess) * v + noise.speed_noise_floor,
        (noise.turn_noise + guess) * abs(w) + noise.turn_noise_floor,
        noise.lateral_noise * v,
    ])  # fmt: skip
    piece = np.array([v, w, dt / n, *(sigma**2 * (noise.noise_interval * n / dt)), 0.0, 0.0])
    return Motion(delta, integrate(*np.tile(piece[:, None], n))[1:4])


def is_possible(delta: Array, dt: float, noise: MotionNoise) -> bool:
    """Whether a robot can move by ``delta`` (3,) in ``dt`` [s]; one interval at least counts.

    Stamps of one burst are too close to divide by.
    """
    over = max(dt, noise.noise_interval)
    far = math.hypot(delta[0], delta[1])
    return far <= noise.max_speed * over and abs(delta[2]) <= noise.max_turn_rate * over


class _Noise(NamedTuple):
    """MotionNoise as kernels take it."""

    speed_noise: float
    speed_noise_floor: float
    turn_noise: float
    turn_noise_floor: float
    lateral_noise: float
    imu_turn_noise: float
    imu_turn_noise_floor: float
    noise_interval: float
    long_interval_noise: float
    max_gap: float
    max_speed: float
    max_turn_rate: float
    moves_sideways: float  # 1: the robot can, or its base is not on the axle; 0: it cannot


@brief
def _drive(
    start: int,
    end: int,
    stamps: Stamps,
    twists: Array,
    imu_stamps: Stamps,
    rates: Array,
    n: _Noise,
) -> tuple[Array, bool, float, float, float, float]:
    """Motion between two stamps: integrate(), known, bias, its variance, bias_turn, bias_way.

    ``twists`` (k, 3) are the velocities of the intervals that end at the odometry's ``stamps``,
    ``rates`` those measured by the IMU at its own. Between two stamps of either, the control is
    that of the middle (eq. 6). Of a gap that is all between the two stamps, the odometry says
    where it led to. A part of one longer than max_gap is unknown, but for COAST at its ends.
    """
    cuts = _cuts(start, end, stamps, imu_stamps, n.max_gap)
    m = len(cuts) - 1
    rows = np.empty((8, m))
    all_known = True
    weight = weighted = turned = drove = 0.0
    open2 = turned2 = 0.0  # [s^2] near the end of a long gap, of which odometry says nothing
    beside2 = 0.0  # [m^2] by which errors of the heading on a way that is not known led aside
    for k in range(m):
        dt = (cuts[k + 1] - cuts[k]) / SECOND
        middle = (cuts[k] + cuts[k + 1]) // 2
        by_wheels = _by_wheels(cuts[k], cuts[k + 1], start, end, stamps, twists, n)
        at, known, bridged, unsure, speed, sideways, turn, sigma_v, sigma_w, aside2 = by_wheels
        beside2 += aside2
        # the wheels do not turn: so does the robot not, and the IMU shows its bias
        stands = known and speed == 0.0 and sideways == 0.0 and turn == 0.0
        if stands:
            sigma_v, sigma_w = STANDING * n.speed_noise_floor, STANDING * n.turn_noise_floor
        gyro_gap = GYRO_GAP if known else n.max_gap
        rate = np.nan if bridged else _rate(middle, imu_stamps, rates, gyro_gap)
        sigma_rate = n.imu_turn_noise * abs(rate) + n.imu_turn_noise_floor
        bias, bias_sigma = rate - turn, math.hypot(sigma_rate, sigma_w)
        says_bias = known and not math.isnan(rate)
        gyro = 0.0
        if not stands and not math.isnan(rate):
            turn, sigma_w, gyro = rate, sigma_rate, 1.0
        # The noise is given for n.noise_interval; a shorter interval accumulates the same noise.
        # Where the motion is too fast for its interval, the stamps are wrong, not the noise.
        way = abs(speed) if n.moves_sideways == 0.0 else math.hypot(speed, sideways)
        lasted = max(dt, way * dt / n.max_speed, abs(turn) * dt / n.max_turn_rate)
        scale = along = n.noise_interval / lasted
        lateral = n.lateral_noise * math.hypot(speed, sideways)
        if not known:
            # one unknown speed for all of a gap: the variance of the way goes with the square of
            # the time since odometry ended, and that of a part is what it grows by
            lateral, since = n.max_speed / 5.0, _since(middle, stamps, at)
            along = max(n.noise_interval, 2.0 * since) / dt
        rows[0, k], rows[1, k], rows[2, k], rows[6, k] = speed, turn, dt, gyro
        var, var_aside = sigma_v**2 * along, lateral**2 * along
        if n.moves_sideways > 0.0 and way > 0.0:  # along and across the way, wherever that leads
            share = (sideways / way) ** 2
            var, var_aside = (
                (1.0 - share) * var + share * var_aside, share * var + (1.0 - share) * var_aside
            )  # fmt: skip
        rows[3, k], rows[4, k] = var, sigma_w**2 * scale
        rows[5, k], rows[7, k] = var_aside, sideways
        if known:
            open2, turned2 = max(open2, unsure**2), max(turned2, (1.0 - gyro) * unsure**2)
        all_known = all_known and known
        if says_bias:
            weight += 1.0 / (bias_sigma**2 * scale)
            weighted += bias / (bias_sigma**2 * scale)
            turned += gyro * rate / (bias_sigma**2 * scale)
            drove += gyro * speed / (bias_sigma**2 * scale)
    out = integrate(
        rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6], rows[7]
    )  # fmt: skip
    out[1, 0] += open2 * (n.max_speed / 5.0) ** 2 + beside2
    out[2, 1] += open2 * (n.max_speed / 5.0) ** 2 + beside2
    out[3, 2] += turned2 * (n.max_turn_rate / 5.0) ** 2
    if weight > 0.0:
        return out, all_known, weighted / weight, 1.0 / weight, turned / weight, drove / weight
    return out, all_known, 0.0, np.inf, 0.0, 0.0


@part
def _cuts(
    start: int, end: int, stamps: Stamps, imu_stamps: Stamps, max_gap: float
) -> NDArray[np.int64]:
    """All stamps from ``start`` to ``end`` at which odometry or IMU has a sample, with both ends.

    Of the IMU, none in a long gap of odometry that is all between the two.
    """
    cuts = np.empty(len(stamps) + len(imu_stamps) + 2, np.int64)
    cuts[0], m, i, j = start, 1, 0, 0
    while i < len(stamps) or j < len(imu_stamps):
        if j == len(imu_stamps) or (i < len(stamps) and stamps[i] <= imu_stamps[j]):
            stamp = stamps[i]
            i += 1
        else:
            stamp = imu_stamps[j]
            j += 1
            if _is_bridged(i, start, end, stamps, max_gap):
                continue  # the rates say how it turned, but not where it was then
        if cuts[m - 1] < stamp < end:
            cuts[m] = stamp
            m += 1
    cuts[m] = end
    return cuts[: m + 1]


@part
def _by_wheels(
    begin: int, finish: int, start: int, end: int, stamps: Stamps, twists: Array, n: _Noise
) -> tuple[int, bool, bool, float, float, float, float, float, float, float]:
    """What odometry says of the piece from ``begin`` to ``finish``, of all from start to end.

    The number of its next sample, whether it knows the motion, whether it is in a long gap that it
    bridges, time near the end of such a gap [s], speed, sideways speed, turn rate, sigmas of speed
    and turn rate, and variance beside the way [m^2].
    """
    dt, middle = (finish - begin) / SECOND, (finish + begin) // 2
    beside2 = 0.0
    at = int(np.searchsorted(stamps, middle))
    # a robot goes within a control interval before its first odometry as at its beginning
    if at == 0 and len(stamps) > 1 and stamps[0] - start <= n.noise_interval * SECOND:
        at = 1
    known = bool(0 < at < len(stamps) and not math.isnan(twists[at, 0]))
    gap = (stamps[at] - stamps[at - 1]) / SECOND if known else 0.0
    bridged = _is_bridged(at, start, end, stamps, n.max_gap)
    whole = _within(at, start, end, stamps) if known else 0.0
    unsure = min(whole, gap - whole) if gap > n.max_gap else 0.0
    known = known and unsure <= COAST
    speed = sideways = turn = 0.0
    sigma_v, sigma_w = n.max_speed / 5.0, n.max_turn_rate / 5.0
    if known:
        speed, turn = twists[at, 0], twists[at, 2]
        sideways = n.moves_sideways * twists[at, 1]
        way = math.hypot(speed, sideways)
        moved = _share_moved(way, abs(turn), n) if gap > n.max_gap else 1.0
        fast, quick, long_interval_noise = way / moved, abs(turn) / moved, 0.0
        if gap > 2.0 * n.noise_interval:
            # when inside a long interval the motion happened is uncertain; what is left of it
            # at the end is less than what was driven: at least as fast as before, and no arc
            long_interval_noise = n.long_interval_noise
            lasted = RECENT if gap > n.max_gap else n.noise_interval
            before = _speed_before(at - 1, stamps, twists, lasted, n)
            fast, quick = max(fast, before[0]), max(quick, before[1])
            # a constant twist leads along an arc, which is longer than its chord
            half = 0.5 * turn * (finish - begin) / SECOND
            chord = math.sin(half) / half if abs(half) > 1e-4 else 1.0
            speed, sideways = chord * speed, chord * twists[at, 1]
        sigma_v = (n.speed_noise + long_interval_noise) * fast + n.speed_noise_floor
        sigma_w = (n.turn_noise + long_interval_noise) * quick + n.turn_noise_floor
        sigma_v, sigma_w = math.sqrt(moved) * sigma_v, math.sqrt(moved) * sigma_w
        if gap > n.max_gap:
            # eq. 61: it went as far as at its speed before, wherever that led
            usual = min(fast, _speed_before(at - 1, stamps, twists, RECENT, n)[0])
            way2 = ((moved * usual) ** 2 - speed**2 - sideways**2) * dt**2
            beside2 = max(way2, 0.0) * sigma_w**2 * n.noise_interval * dt / 6.0
    return at, known, bridged, unsure, speed, sideways, turn, sigma_v, sigma_w, beside2


@part
def _share_moved(speed: float, turn: float, n: _Noise) -> float:
    """Share of a long gap in which the robot moved, by its mean speed and turn rate; at most 1.

    It may have stood for most of the gap, and wheels that stand add no noise.
    """
    share = speed * n.speed_noise / max(CREEP * n.speed_noise_floor, 1e-9)
    share += turn * n.turn_noise / max(CREEP * n.turn_noise_floor, 1e-9)
    return min(max(share, 1e-3), 1.0)


@part
def _speed_before(
    at: int, stamps: Stamps, twists: Array, interval: float, n: _Noise
) -> tuple[float, float]:
    """Speed and turn rate in an ``interval`` [s] until sample ``at``, without a jump in it.

    Stamps of one burst are too close to divide by.
    """
    far = turned = lasted = 0.0
    while at > 0 and lasted < interval and not math.isnan(twists[at, 0]):
        dt = (stamps[at] - stamps[at - 1]) / SECOND
        speed = math.hypot(twists[at, 0], n.moves_sideways * twists[at, 1])
        far, turned = far + speed * dt, turned + abs(twists[at, 2]) * dt
        lasted += dt
        at -= 1
    lasted = max(lasted, min(interval, COAST))
    return far / lasted, turned / lasted


@part
def _is_bridged(at: int, start: int, end: int, stamps: Stamps, max_gap: float) -> bool:
    """Whether the interval until sample ``at`` is a long gap, all but COAST of it inside."""
    if not 0 < at < len(stamps) or stamps[at] - stamps[at - 1] <= max_gap * SECOND:
        return False
    gap = (stamps[at] - stamps[at - 1]) / SECOND
    return bool(gap - _within(at, start, end, stamps) <= COAST)


@part
def _within(at: int, start: int, end: int, stamps: Stamps) -> float:
    """Seconds between two stamps of the interval that ends at sample ``at``."""
    return float(max(min(end, stamps[at]) - max(start, stamps[at - 1]), 0) / SECOND)


@part
def _since(stamp: int, stamps: Stamps, at: int) -> float:
    """Seconds to the sample ``at - 1`` before a stamp, where there is none to the first one."""
    if not len(stamps):
        return 0.0
    return float(abs(stamp - stamps[max(at - 1, 0)]) / SECOND)


@part
def _rate(stamp: int, stamps: Stamps, rates: Array, max_gap: float) -> float:
    """The IMU's yaw rate, linear between its samples; NaN outside or across a gap."""
    k = np.searchsorted(stamps, stamp)
    if not 0 < k < len(stamps):
        return np.nan
    t0, t1 = stamps[k - 1], stamps[k]
    if t1 - t0 > max_gap * SECOND:
        return np.nan
    f = (stamp - t0) / (t1 - t0)
    return float(rates[k - 1] * (1.0 - f) + rates[k] * f)


def _around(stamps: list[int], start: int, end: int, before: int = 0) -> slice:
    """The samples from ``before`` [ns] ahead of a stamp to another, and one on each side."""
    return slice(max(bisect_right(stamps, start - before) - 1, 0), bisect_left(stamps, end) + 1)


class MotionBuffer:
    """Odometry and IMU of the last ``memory`` seconds, and the motion between any two stamps."""

    def __init__(self, noise: MotionNoise, memory: float) -> None:
        self._noise = noise
        values = {name: float(getattr(noise, name, 0.0)) for name in _Noise._fields}
        self._noise_values = _Noise(**values)
        self._way = self._aside = 0.0  # [m] since the last look at how the robot moves
        self._memory = int(memory * SECOND)
        self._stamps: list[int] = []
        self._poses: list[Array] = []
        # velocity (3,) of the interval that ends at the sample of the same index
        self._twists: list[Array] = [np.zeros(3)]
        self._imu_stamps: list[int] = []
        self._rates: list[float] = []
        self._parked: Odometry | None = None
        self._delay = 0

    @property
    def newest(self) -> int | None:
        """Stamp of the newest odometry, None before the first."""
        return self._stamps[-1] if self._stamps else None

    def newest_until(self, stamp: int) -> int | None:
        """Stamp of the newest odometry not later than a stamp, None without any."""
        k = bisect_right(self._stamps, stamp)
        return self._stamps[k - 1] if k else None

    def add_odometry(self, sample: Odometry) -> bool:
        """Append a sample, unless it is no later than the newest one; False if it jumps.

        One sample that jumps away and is not followed by another there is a fault and dropped;
        two that agree are odometry that was reset, across which the motion is unknown.
        """
        if self._delay:
            sample = Odometry(sample.stamp - self._delay, sample.pose)
        if self._stamps and sample.stamp <= self._stamps[-1]:
            return True
        if self._stamps:
            step = self._step(self._stamps[-1], self._poses[-1], sample)
            if step is None:
                parked, self._parked = self._parked, sample
                if parked is None or parked.stamp >= sample.stamp:
                    return False
                if self._step(parked.stamp, parked.pose, sample) is None:
                    return False
                step = np.full(3, np.nan)
            elif self._has_restarted(sample):
                step = np.full(3, np.nan)
            else:
                self._learn_whether_sideways(step, (sample.stamp - self._stamps[-1]) / SECOND)
            self._twists.append(step)
        self._parked = None
        self._stamps.append(sample.stamp)
        self._poses.append(np.array(sample.pose, dtype=np.float64))
        self._forget(self._stamps, sample.stamp, self._poses, self._twists)
        return True

    def set_odometry_delay(self, delay: int) -> None:
        """Odometry, that which is there as well, was measured ``delay`` [ns] before its stamp."""
        self._stamps = [stamp + self._delay - delay for stamp in self._stamps]
        self._delay = delay

    def _step(self, stamp: int, pose: Array, sample: Odometry) -> Array | None:
        """Velocity (3,) since an earlier sample, None where no robot moves like that."""
        dt = (sample.stamp - stamp) / SECOND
        step = se2.log(se2.between(pose, sample.pose))
        if not is_possible(step, dt, self._noise):
            return None
        return step / dt

    def _learn_whether_sideways(self, twist: Array, dt: float) -> None:
        """Find out once whether the base moves across its heading by more than odometry rounds.

        It does where the wheels can, and where it does not sit on their axle.
        """
        if dt > 2.0 * self._noise.noise_interval:
            return  # of long intervals it counts anyway
        self._way += math.hypot(twist[0], twist[1]) * dt
        self._aside += float(twist[1]) * dt
        if self._way > WAY:
            if abs(self._aside) > ASIDE * self._way:
                self._noise_values = self._noise_values._replace(moves_sideways=1.0)
            self._way = self._aside = 0.0

    def _has_restarted(self, sample: Odometry) -> bool:
        """Whether odometry is at zero after a long gap and was not before it: it began again."""
        long = sample.stamp - self._stamps[-1] > self._noise.max_gap * SECOND
        return long and _is_zero(sample.pose) and not _is_zero(self._poses[-1])

    def add_imu(self, sample: Imu) -> None:
        """Append a sample, unless it is no later than the newest one."""
        if self._imu_stamps and sample.stamp <= self._imu_stamps[-1]:
            return
        self._imu_stamps.append(sample.stamp)
        self._rates.append(sample.yaw_rate)
        self._forget(self._imu_stamps, sample.stamp, self._rates)

    def _forget(self, stamps: list[int], now: int, *columns: list) -> None:  # type: ignore[type-arg]
        # in batches: deleting from the front of a list moves all of it
        if len(stamps) > 2 * BATCH and stamps[BATCH] < now - self._memory:
            k = min(bisect_left(stamps, now - self._memory), len(stamps) - BATCH)
            for column in (stamps, *columns):
                del column[:k]

    def extrapolate(self, start: int, end: int) -> Motion:
        """Motion from ``start`` to ``end`` where odometry ends before the latter.

        The last speed goes on for COAST at most; an IMU that still measures gives the turn. The
        variance of the rest grows with the square of the time since odometry ended, as one unknown
        speed's does: that of a part is what it grows by, so parts add up to the whole.
        """
        newest = self.newest
        if newest is None:
            return self.motion(start, end)
        covered = self.motion(start, newest)
        begin = max(newest, start)
        since, until = (begin - newest) / SECOND, (end - newest) / SECOND
        unmeasured = self.motion(begin, end)
        has_gyro = bool(unmeasured.bias_gain.any())
        coasted = min(until, COAST) - min(since, COAST)
        twist = self._twists[-1]
        lasted = len(self._stamps) > 1 and self._stamps[-1] - self._stamps[-2] >= SECOND // 100
        if math.isnan(twist[0]) or not lasted:
            twist = np.zeros(3)
        turn = unmeasured.delta[2] if has_gyro else twist[2] * coasted
        n = self._noise
        cov = np.diag([n.max_speed / 5.0, n.max_speed / 20.0, n.max_turn_rate / 5.0]) ** 2
        cov *= until**2 - since**2
        if has_gyro:
            cov[2, 2] = unmeasured.cov[2, 2]
        delta = se2.exp(np.array([twist[0] * coasted, twist[1] * coasted, turn]))
        turn_gain = np.zeros(3) if has_gyro else np.array([0.0, 0.0, turn])
        drift_gain = np.zeros(3) if has_gyro else np.array([0.0, 0.0, delta[0]])
        rest = Motion(
            delta, cov, False, unmeasured.bias_gain, turn_gain=turn_gain, drift_gain=drift_gain
        )
        return compose_motion(covered, rest)

    def forget_after(self, stamp: int) -> None:
        """Drop all samples later than a stamp: their clock was wrong."""
        self.forget_odometry_after(stamp)
        self.forget_imu_after(stamp)

    def forget_odometry_after(self, stamp: int) -> None:
        """Drop the odometry later than a stamp."""
        k = bisect_right(self._stamps, stamp - self._delay)
        del self._stamps[k:], self._poses[k:], self._twists[k:]
        if not self._twists:
            self._twists.append(np.zeros(3))

    def forget_imu_after(self, stamp: int) -> None:
        """Drop the IMU's samples later than a stamp."""
        k = bisect_right(self._imu_stamps, stamp)
        del self._imu_stamps[k:], self._rates[k:]

    def covers(self, stamp: int) -> bool:
        """Whether odometry before and after the stamp is there."""
        return bool(self._stamps) and self._stamps[0] <= stamp <= self._stamps[-1]

    def gap_at(self, stamp: int) -> int:
        """Length [ns] of the odometry's interval around a stamp, 0 within COAST of its ends."""
        k = bisect_left(self._stamps, stamp)
        if not 0 < k < len(self._stamps):
            return 0
        before, after = self._stamps[k - 1], self._stamps[k]
        near = min(stamp - before, after - stamp) <= COAST * SECOND
        return 0 if near else after - before

    def pose_at(self, stamp: int) -> Array | None:
        """Raw odometry pose (3,) that has the stamp, None outside of what is known."""
        stamp -= self._delay
        if not self.covers(stamp):
            return None
        k = bisect_left(self._stamps, stamp)
        if self._stamps[k] == stamp:
            return self._poses[k]
        t0, t1 = self._stamps[k - 1], self._stamps[k]
        return se2.interpolate(self._poses[k - 1], self._poses[k], (stamp - t0) / (t1 - t0))

    def motion(self, start: int, end: int) -> Motion:
        """Relative motion of base from stamp ``start`` to ``end`` (eq. 5-9).

        Parts without odometry, across a gap or a jump, count as standing still with the noise of
        one unknown speed, and make the result ``known=False``. A control interval before the first
        odometry is none of them: its first speed holds there too.
        """
        if end <= start:
            return STILL
        is_long = end - start > self._noise.max_gap * SECOND
        before = RECENT if is_long else self._noise.noise_interval
        odometry = _around(self._stamps, start, end, int(before * SECOND))
        imu = _around(self._imu_stamps, start, end)
        out, known, bias, variance, turned, drove = _drive(
            start, end,
            np.array(self._stamps[odometry], dtype=np.int64),
            np.array(self._twists[odometry], dtype=np.float64).reshape(-1, 3),
            np.array(self._imu_stamps[imu], dtype=np.int64),
            np.array(self._rates[imu], dtype=np.float64),
            self._noise_values,
        )  # fmt: skip
        out[0, 2] = se2.wrapped(out[0, 2])
        return Motion(
            out[0], out[1:4], known, out[4], bias, variance, out[5], turned, out[6], drove
        )


def _is_zero(pose: Array) -> bool:
    return bool((np.abs(pose) < ZERO).all())


def warm_up() -> None:
    """Compile the kernels."""
    integrate(*np.ones((8, 1)))
    buffer = MotionBuffer(MotionNoise(), 1.0)
    buffer.motion(1, 2)
