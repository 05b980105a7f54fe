// Values of a message as words: see ng_words.py.  Of a schema folder and of the folder dist of openigtlink-ng.
import { readFileSync, readdirSync } from "node:fs";
import { pathToFileURL } from "node:url";

export async function load(folder, dist) {
  const from = (path) => import(pathToFileURL(`${dist}/${path}`).href);
  const [codec, oracle, net] = [await from("codec.js"), await from("runtime/oracle.js"), await from("net/index.js")];
  await from("messages/index.js");
  const fields = new Map();
  for (const name of readdirSync(folder)) {
    const schema = JSON.parse(readFileSync(`${folder}/${name}`, "utf-8"));
    fields.set(schema.type_id, schema.fields);
  }
  return { ...codec, ...oracle, ...net, fields };
}

const isInteger = (kind) => /^u?int(8|16|32|64)$/.test(kind);
const isFloat = (kind) => kind === "float32" || kind === "float64";
export const octets = (data) => "x" + Buffer.from(data).toString("hex");
export const text = (value) => (typeof value === "string" ? octets(Buffer.from(value, "utf-8")) : octets(value));

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

// The words of an envelope; `around` are those of its message id and its metadata.
export function shown(ng, { header, body }, around = ["i0", "n0"]) {
  const words = ["i" + header.version, text(header.typeId), text(header.deviceName), "i" + header.timestamp, ...around];
  for (const field of ng.fields.get(header.typeId)) write(field, body[field.name], words);
  return words.join(" ");
}

// The version, the body, the device name and the stamp of a message without metadata.
export function made(ng, line) {
  const [version, kind, deviceWord, ticks, , count, ...rest] = line.split(" ");
  if (count !== "n0") throw new Error("found metadata");
  const typeId = Buffer.from(kind.slice(1), "hex").toString("latin1");
  const words = rest.values();
  const values = Object.fromEntries(ng.fields.get(typeId).map((field) => [field.name, read(field, words)]));
  const body = new (ng.lookupMessageClass(typeId))(values);
  const deviceName = Buffer.from(deviceWord.slice(1), "hex").toString("latin1");
  return { version: Number(version.slice(1)), typeId, body, deviceName, timestamp: BigInt(ticks.slice(1)) };
}
