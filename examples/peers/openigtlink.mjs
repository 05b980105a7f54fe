// OpenIGTLink for browsers: whole messages to bytes and back, and a pose.  Lengths are millimetres.

const HEADER = 58;

// CRC-64 of ECMA-182, in two halves: numbers of JavaScript have 53 bits.
const HIGH = new Uint32Array(256), LOW = new Uint32Array(256);
for (let byte = 0; byte < 256; byte++) {
  let high = byte << 24, low = 0;
  for (let bit = 0; bit < 8; bit++) {
    const carry = high < 0;
    high = (high << 1) | (low >>> 31);
    low <<= 1;
    if (carry) { high ^= 0x42f0e1eb; low ^= 0xa9ea3693; }
  }
  HIGH[byte] = high;
  LOW[byte] = low;
}

export function crc64(bytes) {
  let high = 0, low = 0;
  for (const byte of bytes) {
    const at = (high >>> 24) ^ byte;
    high = ((high << 8) | (low >>> 24)) ^ HIGH[at];
    low = (low << 8) ^ LOW[at];
  }
  return (BigInt(high >>> 0) << 32n) | BigInt(low >>> 0);
}

/** A message of header version 1; `ms` is the time since 1970. */
export function pack(type, device, body, ms = performance.timeOrigin + performance.now()) {
  const message = new Uint8Array(HEADER + body.length), view = new DataView(message.buffer);
  view.setUint16(0, 1);
  const names = new TextEncoder();
  message.set(names.encode(type).subarray(0, 12), 2);
  message.set(names.encode(device).subarray(0, 20), 14);
  view.setUint32(34, Math.floor(ms / 1000));
  view.setUint32(38, ((ms % 1000) / 1000) * 2 ** 32);
  view.setBigUint64(42, BigInt(body.length));
  view.setBigUint64(50, crc64(body));
  message.set(body, HEADER);
  return message;
}

/** Type, device, time (ms since 1970) and content of a message; without the extended header and metadata of version 2. */
export function unpack(data) {
  const bytes = new Uint8Array(data), view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const text = (from, to) => new TextDecoder().decode(bytes.subarray(from, to)).split("\0")[0];
  let content = bytes.subarray(HEADER);
  if (view.getBigUint64(50) !== crc64(content)) throw new Error("wrong CRC");
  if (view.getUint16(0) >= 2) {
    const start = view.getUint16(HEADER), metadata = view.getUint16(HEADER + 2) + view.getUint32(HEADER + 4);
    content = content.subarray(start, content.length - metadata);
  }
  const ms = view.getUint32(34) * 1000 + (view.getUint32(38) / 2 ** 32) * 1000;
  return { type: text(2, 14), device: text(14, 34), ms, content };
}

/** The 12 numbers of a TRANSFORM: three columns of a rotation, and a position. */
export function packTransform(numbers) {
  const body = new DataView(new ArrayBuffer(48));
  numbers.forEach((number, at) => body.setFloat32(4 * at, number));
  return new Uint8Array(body.buffer);
}

export function unpackTransform(content) {
  const view = new DataView(content.buffer, content.byteOffset, content.byteLength);
  return Array.from({ length: 12 }, (_, at) => view.getFloat32(4 * at));
}
