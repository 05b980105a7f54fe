// Reads an MCAP file as the programs of Foxglove do: every message by @mcap/core, parsed by its own schema with
// @foxglove/rosmsg and @foxglove/rosmsg2-serialization.  Prints the number of messages of each topic, and all values of
// every fiftieth message of a topic.
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { open } from "node:fs/promises";

const EVERY = 50;

// JSON has no whole numbers beyond 2^53, no NaN and no infinity: these go as text.
function plain(value) {
  if (typeof value === "bigint") return { integer: value.toString() };
  if (typeof value === "number" && !Number.isFinite(value)) return { float: String(value) };
  if (ArrayBuffer.isView(value)) return Array.from(value, plain);
  if (Array.isArray(value)) return value.map(plain);
  if (value instanceof Object) return Object.fromEntries(Object.entries(value).map(([key, inner]) => [key, plain(inner)]));
  return value;
}

const handle = await open(process.argv[2], "r");
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(handle),
  decompressHandlers: await loadDecompressHandlers(),
});
const decoders = new Map();
for (const schema of reader.schemasById.values()) {
  const text = new TextDecoder().decode(schema.data);
  decoders.set(schema.id, new MessageReader(parse(text, { ros2: true }), { timeType: "sec,nanosec" }));
}
const counts = {};
const samples = [];
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const channel = reader.channelsById.get(message.channelId);
  const values = decoders.get(channel.schemaId).readMessage(message.data);
  const number = counts[channel.topic] ?? 0;
  if (number % EVERY === 0) samples.push([channel.topic, message.logTime.toString(), plain(values)]);
  counts[channel.topic] = number + 1;
}
await handle.close();
console.log(JSON.stringify({ counts, samples }));
