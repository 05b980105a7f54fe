// The search of the site as its pages run it: the worker of the theme with the index of the site, which gets the message
// that a page sends.  node site_search.js HTML; a query a line of the standard input, a line of JSON (places) for each.
const fs = require("fs");
const path = require("path");
const vm = require("vm");

const html = process.argv[2];
const folder = path.join(html, "assets", "javascripts", "workers");
const program = fs.readFileSync(path.join(folder, fs.readdirSync(folder).find((name) => name.startsWith("search."))), "utf8");
const index = {};
vm.runInNewContext(fs.readFileSync(path.join(html, "search.js"), "utf8"), index);
const items = JSON.parse(fs.readFileSync(path.join(html, "search.json"), "utf8")).items;

let answered;
const self = { postMessage: (message) => answered(message) };
vm.runInNewContext(program, { self, Intl });
const ask = (data) => new Promise((done) => ((answered = done), self.onmessage({ data })));

(async () => {
  await ask({ type: 0, data: index.__index });
  for (const input of fs.readFileSync(0, "utf8").split("\n").filter(Boolean)) {
    const operator = { type: "operator", data: { operator: "and", operands: [] } };
    const filter = { input: operator, aggregation: { input: [{ type: "term", data: { field: "tags" } }] } };
    const { data } = await ask({ type: 2, data: { input, filter } });
    console.log(JSON.stringify(data.items.map(({ id }) => items[id].location)));
  }
})();
