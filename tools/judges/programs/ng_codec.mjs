// The TypeScript codec of openigtlink-ng, built: as ng_codec.py.  Arguments: folder of its schemas, folder dist.
import { readFileSync, readdirSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [folder, dist] = process.argv.slice(2);
const load = (path) => import(pathToFileURL(`${dist}/${path}`).href);
const { unpackEnvelope, packEnvelope, lookupMessageClass } = await load("codec.js");
const { parseWire } = await load("runtime/oracle.js");
await load("messages/index.js");

const fields = new Map();
for (const name of readdirSync(folder)) {
  const schema = JSON.parse(readFileSync(`${folder}/${name}`, "utf-8"));
  fields.set(schema.type_id, schema.fields);
}
const isInteger = (kind) => /^u?int(8|16|32|64)$/.test(kind);
const isFloat = (kind) => kind === "float32" || kind === "float64";
const octets = (data) => "x" + Buffer.from(data).toString("hex");
const text = (value) => (typeof value === "string" ? octets(Buffer.from(value, "utf-8")) : octets(value));

function floats(values) {
  const data = Buffer.alloc(8 * values.length);
  for (let i = 0; i < values.length; i++) {
    if (Number.isNaN(values[i])) data.writeBigUInt64BE(0x7ff8000000000000n, 8 * i);
    else data.writeDoubleBE(values[i], 8 * i);
  }
  return "F" + data.toString("hex");
}

function write(field, value, words) {
  const element = field.element_type;
  if (isInteger(field.type)) words.push("i" + value);
  else if (isFloat(field.type)) words.push(floats([value]));
  else if (field.type !== "array") words.push(text(value));
  else if (isFloat(element)) words.push(floats(value));
  else if (element === "uint8") words.push(octets(value));
  else if (typeof element === "string") words.push("I" + Array.from(value).join(","));
  else {
    words.push("n" + value.length);
    for (const one of value) {
      if (element.type === "struct") for (const each of element.fields) write(each, one[each.name], words);
      else write(element, one, words);
    }
  }
}

const ARRAYS = { uint16: Uint16Array, float32: Float32Array, float64: Float64Array };

function read(field, words) {
  const word = words.next().value;
  const body = word.slice(1);
  const element = field.element_type;
  const isFixed = typeof field.count === "number";
  if (word[0] === "i") return /64$/.test(field.type) ? BigInt(body) : Number(body);
  if (word[0] === "I") {
    const values = body ? body.split(",").map(Number) : [];
    return isFixed ? values : ARRAYS[element].from(values);
  }
  if (word[0] === "F") {
    const data = Buffer.from(body, "hex");
    const values = Array.from({ length: data.length / 8 }, (_, i) => data.readDoubleBE(8 * i));
    if (field.type !== "array") return values[0];
    return isFixed ? values : ARRAYS[element].from(values);
  }
  if (word[0] === "x") {
    const data = Buffer.from(body, "hex");
    const isText = field.type !== "array" && field.encoding !== "binary";
    return isText ? data.toString("latin1") : new Uint8Array(data);
  }
  const one = () => {
    if (element.type !== "struct") return read(element, words);
    return Object.fromEntries(element.fields.map((each) => [each.name, read(each, words)]));
  };
  return Array.from({ length: Number(body) }, one);
}

function decoded(data) {
  const envelope = unpackEnvelope(data);
  const { header, body } = envelope;
  const words = ["i" + header.version, text(header.typeId), text(header.deviceName), "i" + header.timestamp];
  let again;
  if (header.version === 1) {
    words.push("i0", "n0");
    again = packEnvelope(envelope);
  } else {
    const framing = parseWire(data);
    if (!framing.ok) throw new Error(framing.error);
    words.push("i" + framing.extendedHeader.messageId, "n" + framing.metadata.length);
    for (const { key, encoding, value } of framing.metadata) words.push(text(key), "i" + encoding, octets(value));
    // packEnvelope has neither: what stands around the content is kept, as its own oracle does
    again = Buffer.concat([data.subarray(0, 58), framing.extHeaderBytes, body.pack(), framing.metadataBytes]);
  }
  for (const field of fields.get(header.typeId)) write(field, body[field.name], words);
  return [words.join(" "), again];
}

function encoded(line) {
  const [version, kind, device, ticks, , count, ...rest] = line.split(" ");
  if (version !== "i1" || count !== "n0") throw new Error("found another header");
  const typeId = Buffer.from(kind.slice(1), "hex").toString("latin1");
  const words = rest.values();
  const values = Object.fromEntries(fields.get(typeId).map((field) => [field.name, read(field, words)]));
  const body = new (lookupMessageClass(typeId))(values);
  const deviceName = Buffer.from(device.slice(1), "hex").toString("latin1");
  return packEnvelope({ header: { version: 1, typeId, deviceName, timestamp: BigInt(ticks.slice(1)) }, body });
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
