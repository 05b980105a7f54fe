// The client or the server of openigtlink-ng in TypeScript, as ng_peer.py.  Arguments: folder of its schemas, folder
// dist, `client` PORT or `server`.
import { createInterface } from "node:readline";

import { load, made, shown } from "./ng_words.mjs";

const [schemas, dist, role, port] = process.argv.slice(2);
const ng = await load(schemas, dist);
const report = (fields) => process.stdout.write(JSON.stringify(fields) + "\n");
const take = (envelope) => {
  report({ words: shown(ng, envelope), data: Buffer.from(ng.packEnvelope(envelope)).toString("hex") });
};

let link;
const here = role === "server" ? await ng.Server.listen(0) : await ng.Client.connect("127.0.0.1", Number(port));
for (const name of ng.registeredTypes()) here.on(ng.lookupMessageClass(name), take);
here.onError?.((error) => report({ refused: error.message }));
if (role === "server") {
  here.onPeerConnected((peer) => {
    link = peer;
    report({ connected: true });
  });
  report({ port: here.port });
} else {
  link = here;
  here.run();
  report({ connected: true });
}

for await (const line of createInterface({ input: process.stdin })) {
  let sent = "";
  try {
    const { body, deviceName, timestamp } = made(ng, line);
    await link.send(body, { deviceName, timestamp });
  } catch (error) {
    sent = error.message;
  }
  report({ sent });
}
process.exit(0);
