# SPDX-License-Identifier: Apache-2.0
"""The bags of bags/ are what bags/README.md says, and what its commands write today."""

import argparse
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from rlml_slam.cli import simulate
from rlml_slam.params import Reflector
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import decode

BAGS = Path(__file__).resolve().parents[2] / 'bags'
README = (BAGS / 'README.md').read_text(encoding='utf-8')
COMMANDS = {
    words[3]: words[1:]
    for text in re.findall(r'^rlml simulate (?:.*\\\n)*.*$', README, re.MULTILINE)
    for words in [shlex.split(text.replace('\\\n', ' '))]
}


def read(path):
    with BagReader(path) as bag:
        return list(bag.messages())


def test_every_bag_has_its_command_and_both_storages_are_there():
    folders = {f'bags/{p.name}' for p in BAGS.iterdir() if p.is_dir()}
    assert folders == set(COMMANDS)
    assert {f.suffix for p in BAGS.iterdir() if p.is_dir() for f in p.iterdir()} == {
        '.mcap', '.db3', '.yaml'
    }  # fmt: skip


@pytest.mark.parametrize('bag', sorted(COMMANDS))
def test_a_bag_is_small_and_has_every_topic_of_the_readme(bag):
    assert sum(f.stat().st_size for f in (BAGS.parent / bag).iterdir()) <= 2_000_000
    with BagReader(BAGS.parent / bag) as reader:
        found = {t.name: t.msgtype.replace('/msg/', '/') for t in reader.topics.values()}
    listed = dict(re.findall(r'^\| `(/\w+)` \| (\w+/\w+) \|', README, re.MULTILINE))
    assert found == listed


@pytest.mark.parametrize('bag', sorted(COMMANDS))
def test_the_command_still_writes_the_same_messages(bag, tmp_path):
    """Not by bytes: sines of another processor may differ in the last digit."""
    words = [str(tmp_path / 'bag') if w == bag else w for w in COMMANDS[bag]]
    parser = argparse.ArgumentParser()
    simulate.add_parser(parser.add_subparsers())
    assert simulate.run(parser.parse_args(words)) == 0
    new, old = read(tmp_path / 'bag'), read(BAGS.parent / bag)
    assert [(time, topic) for time, topic, _ in new] == [(time, topic) for time, topic, _ in old]
    for (_, topic, a), (_, _, b) in zip(new, old, strict=True):
        if topic in ('/odom', '/ground_truth'):
            pose = decode.odometry(b).pose
            np.testing.assert_allclose(decode.odometry(a).pose, pose, atol=1e-6)
        elif topic == '/scan':
            x, y = np.array(a.ranges), np.array(b.ranges)
            # a ray that just misses an edge may hit it on another processor
            assert np.isclose(x, y, rtol=1e-4, atol=0.0, equal_nan=True).mean() > 0.98
        elif topic == '/reflectors':
            p, q = (decode.detections(m, Reflector()).points for m in (a, b))
            np.testing.assert_allclose(p, q, atol=1e-4)
