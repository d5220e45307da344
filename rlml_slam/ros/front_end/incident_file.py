# SPDX-License-Identifier: Apache-2.0
"""One incident as one MCAP file: inputs as they came, poses and health as they were published.

It is imported where one is written: nodes that write none need no rosbags.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

from rlml_slam.params import Parameters, changed
from rlml_slam.ros.bags.bag import BagWriter
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import bag_types, make_bag
from rlml_slam.ros.front_end.incident import PREFIX, Published, Received
from rlml_slam.version import __version__

STALE = 3600.0  # [s] after which what a killed process began is removed


def write(
    path: Path,
    about: dict[str, object],
    static: Sequence[Received],
    received: Sequence[Received],
    published: Sequence[Published],
    params: Parameters,
) -> None:
    """Write a file, which appears whole or not at all. Raises BagError.

    ``static`` are latched messages, which begin it.
    """
    known, n = bag_types().fielddefs, params.node
    times = [r.time for r in received[:1]] + [e.time for e in published[:1]]
    begin = min(times, default=time.time_ns())
    about = {'version': __version__, **about, 'parameters': changed(params)}
    with BagWriter(path) as bag:
        for latched, some in ((True, static), (False, received)):
            for r in some:
                if r.kind in known:
                    bag.add_topic(r.topic, r.kind, latched)
        bag.write('/incident', make_bag('std_msgs/msg/String', data=json.dumps(about)), begin)
        for r in static:
            if r.kind in known:
                bag.write_serialized(r.topic, r.data, begin)
        events = [(r.time, 0, k) for k, r in enumerate(received) if r.kind in known]
        events += [(e.time, 1, k) for k, e in enumerate(published)]
        last = begin
        for time_, is_own, k in sorted(events):
            at = last = max(time_, last + 1)  # equal times would leave the order to readers
            if not is_own:
                bag.write_serialized(received[k].topic, received[k].data, at)
                continue
            e = published[k]
            pose = encode.pose_with_covariance(
                make_bag, e.stamp, n.map_frame, e.T_map_base, e.cov_map
            )
            bag.write('/pose', pose, at)
            status = encode.diagnostic_status(make_bag, 'front_end', e.health, {})
            status.level = int(e.health.level)  # a byte is a number in bags
            bag.write('/front_end/health', status, at)


def make_room(folder: Path, most: float) -> None:
    """Remove the oldest incidents beyond ``most`` bytes, and what killed processes left."""
    files = sorted(folder.glob(f'{PREFIX}*.mcap'), key=lambda f: f.stat().st_mtime)
    size = sum(f.stat().st_size for f in files)
    for file in files[:-1]:
        if size <= most:
            break
        size -= file.stat().st_size
        file.unlink(missing_ok=True)
    for left in folder.glob('.bag-*'):
        if time.time() - left.stat().st_mtime > STALE:
            shutil.rmtree(left, ignore_errors=True)
