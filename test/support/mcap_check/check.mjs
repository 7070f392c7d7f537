// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
//
// node check.mjs FILE.mcap ...: reads files of a bag with the libraries of web viewers and
// prints their content as JSON, one entry per file. It verifies the checksums of the summary,
// the chunks, the attachments and the data section, the message indexes, and that each message
// decodes with the schema in the bag.

import { readFile } from 'node:fs/promises';

import { parse } from '@foxglove/rosmsg';
import { MessageReader } from '@foxglove/rosmsg2-serialization';
import { McapIndexedReader, McapStreamReader } from '@mcap/core';
import { decompress } from 'fzstd';

const decompressHandlers = {
  zstd: (data, size) => decompress(data, new Uint8Array(Number(size))),
};

async function checkFile(path) {
  const content = await readFile(path);

  // Sequential: McapStreamReader verifies the checksums of the chunks and of the data section.
  const streamReader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  streamReader.append(content);
  let streamed = 0;
  const attachments = [];
  let dataSectionCrc = 0;
  let footerCrc = 0;
  for (let record; (record = streamReader.nextRecord()) != undefined; ) {
    if (record.type === 'Message') streamed += 1;
    if (record.type === 'Attachment') {
      const { name, mediaType, data } = record;
      attachments.push({ name, mediaType, content: Buffer.from(data).toString('base64') });
    }
    if (record.type === 'DataEnd') dataSectionCrc = record.dataSectionCrc;
    if (record.type === 'Footer') footerCrc = record.summaryCrc;
  }
  if (!streamReader.done()) throw new Error('the file does not end where it should');

  // Indexed: McapIndexedReader verifies the checksum of the summary when it opens the file.
  const readable = {
    size: async () => BigInt(content.length),
    read: async (offset, size) =>
      new Uint8Array(content.buffer, content.byteOffset + Number(offset), Number(size)),
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const decoders = new Map();
  for (const [id, schema] of reader.schemasById) {
    if (schema.encoding !== 'ros2msg') throw new Error(`schema encoding ${schema.encoding}`);
    const definition = parse(new TextDecoder().decode(schema.data), { ros2: true });
    decoders.set(id, new MessageReader(definition));
  }
  const topics = {};
  const last = {};
  let previous = 0n;
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    if (message.logTime < previous) throw new Error('the index is out of order');
    previous = message.logTime;
    const channel = reader.channelsById.get(message.channelId);
    topics[channel.topic] = (topics[channel.topic] ?? 0) + 1;
    last[channel.topic] = decoders.get(channel.schemaId).readMessage(message.data);
  }
  const indexed = [];
  for await (const record of reader.readAttachments({ validateCrcs: true })) {
    indexed.push(record.name);
  }
  if (indexed.length !== attachments.length) throw new Error('an attachment is not indexed');
  const metadata = {};
  for await (const record of reader.readMetadata()) {
    metadata[record.name] = Object.fromEntries(record.metadata);
  }
  return {
    profile: reader.header.profile,
    streamed,
    attachments,
    dataSectionCrc,
    footerCrc,
    chunks: reader.chunkIndexes.length,
    compression: [...new Set(reader.chunkIndexes.map((chunk) => chunk.compression))],
    statistics: reader.statistics.messageCount,
    topics,
    last,
    metadata,
    channels: [...reader.channelsById.values()].map((channel) => ({
      topic: channel.topic,
      encoding: channel.messageEncoding,
      ...Object.fromEntries(channel.metadata),
    })),
  };
}

const plain = (_, value) => {
  if (typeof value === 'bigint') return String(value);
  return ArrayBuffer.isView(value) ? Array.from(value) : value;
};
const found = [];
for (const path of process.argv.slice(2)) found.push(await checkFile(path));
console.log(JSON.stringify(found, plain));
