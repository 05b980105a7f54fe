// The TypeScript codec of openigtlink-ng, built: as ng_codec.py.  Arguments: folder of its schemas, folder dist.
import { load, made, octets, shown, text } from "./ng_words.mjs";

const ng = await load(...process.argv.slice(2));

function decoded(data) {
  const envelope = ng.unpackEnvelope(data);
  if (envelope.header.version === 1) return [shown(ng, envelope), ng.packEnvelope(envelope)];
  const framing = ng.parseWire(data);
  if (!framing.ok) throw new Error(framing.error);
  const around = ["i" + framing.extendedHeader.messageId, "n" + framing.metadata.length];
  for (const { key, encoding, value } of framing.metadata) around.push(text(key), "i" + encoding, octets(value));
  // packEnvelope has neither: what stands around the content is kept, as its own oracle does
  const parts = [data.subarray(0, 58), framing.extHeaderBytes, envelope.body.pack(), framing.metadataBytes];
  return [shown(ng, envelope, around), Buffer.concat(parts)];
}

function encoded(line) {
  const { body, ...header } = made(ng, line);
  return ng.packEnvelope({ header, body });
}

function answer(kind, payload) {
  let words = "";
  let data = Buffer.alloc(0);
  let error = "";
  try {
    if (kind === 0x64) [words, data] = decoded(payload);
    else data = encoded(payload.toString("latin1"));
  } catch (failure) {
    error = `${failure.name}: ${failure.message}`;
  }
  const parts = [];
  for (const part of [Buffer.from(words), Buffer.from(data), Buffer.from(error)]) {
    const size = Buffer.alloc(4);
    size.writeUInt32BE(part.length);
    parts.push(size, part);
  }
  return Buffer.concat(parts);
}

let rest = Buffer.alloc(0);
for await (const chunk of process.stdin) {
  rest = rest.length ? Buffer.concat([rest, chunk]) : chunk;
  const answers = [];
  while (rest.length >= 5 && rest.length >= 5 + rest.readUInt32BE(1)) {
    const end = 5 + rest.readUInt32BE(1);
    answers.push(answer(rest[0], rest.subarray(5, end)));
    rest = rest.subarray(end);
  }
  if (answers.length && !process.stdout.write(Buffer.concat(answers))) {
    await new Promise((resolve) => process.stdout.once("drain", resolve));
  }
}
