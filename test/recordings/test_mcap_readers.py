# SPDX-License-Identifier: Apache-2.0
"""Every message of an MCAP file is decoded by the readers that viewers and scripts use."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from rlml_slam.params import Parameters
from rlml_slam.recordings.bag_replay import replay
from rlml_slam.recordings.estimate_bag import TOPICS
from rlml_slam.ros.bags.bag import BagReader

ROOM = Path(__file__).resolve().parents[2] / 'bags' / 'room'
# a folder with: npm install @mcap/core @foxglove/rosmsg @foxglove/rosmsg2-serialization
NODE = os.environ.get('RLML_NODE_FOLDER', '')


@pytest.fixture(scope='module')
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp('mcap') / 'room.mcap'
    replay(ROOM, Parameters(), mcap=path)
    return path


@pytest.fixture(scope='module')
def counts(file):
    """Messages by topic, as rosbags decodes them."""
    found = Counter()
    with BagReader(file) as bag:
        found.update(topic for _, topic, _ in bag.messages())
        assert not bag.skipped
        assert not bag.damage
    return found


def test_mcap_with_ros2_support_decodes_every_message(file, counts):
    found = Counter()
    with file.open('rb') as f:
        reader = make_reader(f, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages():
            assert channel.message_encoding == 'cdr'
            assert schema.encoding == 'ros2msg'
            assert schema.name.endswith(type(message).__name__)
            found[channel.topic] += 1
    assert found == counts


def test_schemas_are_complete(file):
    """Each has the definitions of all types that it names."""
    with file.open('rb') as f:
        summary = make_reader(f).get_summary()
    names = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
    assert {t: names[t] for t in TOPICS} == TOPICS
    for schema in summary.schemas.values():
        text = schema.data.decode()
        defined = {line.split()[1] for line in text.splitlines() if line.startswith('MSG: ')}
        fields = [line.split('#')[0].split() for line in text.splitlines()]
        used = {f[0].partition('[')[0] for f in fields if len(f) >= 2 and '/' in f[0]}
        assert used <= defined, schema.name


@pytest.mark.skipif(
    not (NODE and shutil.which('node')), reason='RLML_NODE_FOLDER with npm packages is not set'
)
def test_packages_of_foxglove_decode_every_message(file, counts):
    script = Path(__file__).with_name('decode_mcap.mjs')
    done = subprocess.run(
        ['node', str(script), str(file), NODE], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == counts
