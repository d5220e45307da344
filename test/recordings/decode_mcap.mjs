// SPDX-License-Identifier: Apache-2.0
// node decode_mcap.mjs FILE FOLDER: decodes every message of an MCAP file as Foxglove does, with
// the packages in FOLDER/node_modules; prints {"topic": count}.
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';

const [file, folder] = process.argv.slice(2);
const require = createRequire(`${folder}/`);
const { McapStreamReader } = require('@mcap/core');
const { parse } = require('@foxglove/rosmsg');
const { MessageReader } = require('@foxglove/rosmsg2-serialization');

const reader = new McapStreamReader({ validateCrcs: true });
reader.append(readFileSync(file));
const schemas = new Map();
const channels = new Map();
const counts = {};
for (let record = reader.nextRecord(); record; record = reader.nextRecord()) {
  if (record.type === 'Schema') {
    if (record.encoding !== 'ros2msg') throw new Error(`${record.name}: ${record.encoding}`);
    const text = new TextDecoder().decode(record.data);
    schemas.set(record.id, new MessageReader(parse(text, { ros2: true })));
  } else if (record.type === 'Channel') {
    channels.set(record.id, record);
  } else if (record.type === 'Message') {
    const { topic, schemaId } = channels.get(record.channelId);
    schemas.get(schemaId).readMessage(record.data);
    counts[topic] = (counts[topic] ?? 0) + 1;
  }
}
if (!reader.done()) throw new Error('the file ends too early');
console.log(JSON.stringify(counts));
