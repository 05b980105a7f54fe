// Counts the messages of an MCAP file by topic, each decoded by its own schema: an independent reader.
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { open } from "node:fs/promises";

const handle = await open(process.argv[2], "r");
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(handle),
  decompressHandlers: await loadDecompressHandlers(),
});
const decoders = new Map();
for (const schema of reader.schemasById.values()) {
  const text = new TextDecoder().decode(schema.data);
  decoders.set(schema.id, new MessageReader(parse(text, { ros2: true })));
}
const counts = {};
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const channel = reader.channelsById.get(message.channelId);
  decoders.get(channel.schemaId).readMessage(message.data);
  counts[channel.topic] = (counts[channel.topic] ?? 0) + 1;
}
await handle.close();
console.log(JSON.stringify(counts));
