"use strict";
/* The page: it asks for the state twice a second and draws what has changed.  Text of others is only ever text. */

const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
const WORDS = { ok: "good", warning: "check", error: "fault", silent: "silent", waiting: "waiting", off: "off" };
const STATES = ["error", "silent", "warning", "waiting", "ok", "off"];  // the worst first
const VIEWS = ["now", "recording", "sessions", "replay"];
let state = null, known = "", role = "full", view = "now", lastAnswer = 0, isLost = false;

// ── elements ──────────────────────────────────────────────────────────────────────────────────────────────────

function h(tag, props, ...children) {
  const [name, ...classes] = tag.split(".");
  const made = document.createElement(name || "div");
  if (classes.length) made.className = classes.join(" ");
  for (const [key, value] of Object.entries(props || {})) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (key.startsWith("aria-")) made.setAttribute(key, value);  // "true" and "false" are words there
    else if (value === true) made.setAttribute(key, "");
    else if (value !== false && value != null) made.setAttribute(key, value);
  }
  if (props?.tabindex === 0) made.dataset.key ||= props["aria-label"];
  made.append(...children.flat(9).filter((child) => child != null && child !== false).map(plain));
  return made;
}
/* Text of others without what turns the direction of the text after it. */
function plain(text) { return typeof text === "string" ? text.replace(/[\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]/g, "\ufffd") : text; }

function svg(tag, props, ...children) {
  const made = document.createElementNS(SVG, tag);
  for (const [key, value] of Object.entries(props || {})) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

const icon = (name) => {
  const made = svg("svg", { class: `icon s-${name}`, "aria-hidden": "true" }, svg("use", { href: `#i-${name}` }));
  return made;
};
const stateCell = (name, word) => h("span.state.s-" + name, null, icon(name), word || WORDS[name]);

function put(place, text) { if (place.textContent !== plain(text)) place.textContent = plain(text); }
function html(place, ...children) { place.replaceChildren(...children.filter((child) => child != null && child !== false)); }
let pressed = null;
document.addEventListener("pointerdown", (event) => { pressed = event.target; }, true);
for (const name of ["pointerup", "pointercancel"]) document.addEventListener(name, () => { pressed = null; }, true);
/* Draw a part again only if what it shows has changed, and not below a pressed button: a click ends where it began. */
function part(place, shown, draw) {
  const text = JSON.stringify(shown);
  if (place._shown === text || (pressed && place.contains(pressed))) return;
  place._shown = text;
  const scrolled = [...place.querySelectorAll("[tabindex='0']")].filter((each) => each.scrollTop).map((each) => [each.dataset.key, each.scrollTop]);
  const focus = place.contains(document.activeElement) ? document.activeElement.dataset.key : null;
  html(place, ...[draw()].flat(9));
  if (focus) place.querySelector(`[data-key="${CSS.escape(focus)}"]`)?.focus();
  for (const [key, top] of scrolled) { const found = place.querySelector(`[data-key="${CSS.escape(key)}"]`); if (found) found.scrollTop = top; }
}

// ── numbers ───────────────────────────────────────────────────────────────────────────────────────────────────

const NONE = "–";
function number(value, digits = 0) { return value.toLocaleString("en-GB", { minimumFractionDigits: digits, maximumFractionDigits: digits }); }
function rate(value) { return value >= 100 ? number(value) : value >= 10 ? number(value, 1) : number(value, 2); }
function bytes(value) {
  for (const unit of ["B", "kB", "MB", "GB", "TB"]) {
    if (value < 999.5 || unit === "TB") return `${number(value, unit === "B" || value >= 100 ? 0 : 1)} ${unit}`;
    value /= 1000;
  }
}
function clock(seconds) {
  const whole = Math.max(0, Math.floor(seconds)), two = (value) => String(value).padStart(2, "0");
  return `${two(Math.floor(whole / 3600))}:${two(Math.floor(whole / 60) % 60)}:${two(whole % 60)}`;
}
function span(seconds) {
  const two = (whole, large, small) => [`${Math.floor(whole / 60)} ${large}`, whole % 60 && `${whole % 60} ${small}`].filter(Boolean).join(" ");
  if (seconds < 59.95) return `${number(seconds, 1).replace(/\.0$/, "")} s`;
  if (seconds < 3599.5) return two(Math.round(seconds), "min", "s");
  if (seconds < 172800) return two(Math.round(seconds / 60), "h", "min");
  return `${number(seconds / 86400)} days`;
}
function age(seconds) { return seconds < 1 ? "now" : seconds < 60 ? `${number(seconds)} s` : span(seconds); }
function moment(seconds) { const m = Math.floor(seconds / 60); return `${m}:${number(seconds - 60 * m, 2).padStart(5, "0")}`; }
function day(ns) { return new Date(ns / 1e6).toLocaleString("sv-SE", { dateStyle: "short", timeStyle: "medium" }).slice(0, 16); }
function time(ns) { return new Date(ns / 1e6).toLocaleTimeString("en-GB"); }
function count(value, thing, things) { return `${number(value)} ${value === 1 ? thing : things || thing + "s"}`; }

function sparkline(text) {
  const values = text ? text.split(" ").map(Number) : [];
  const most = Math.max(...values, 1), n = Math.max(values.length - 1, 1);
  const points = values.map((value, at) => `${((at + 60 - values.length) / 59 * 100).toFixed(1)} ${(20 - value / most * 17).toFixed(1)}`);
  return points.length > 1 && n ? "M" + points.join("L") : "";
}

// ── talking to the program ────────────────────────────────────────────────────────────────────────────────────

async function get(path) {
  const answer = await fetch(path, { signal: AbortSignal.timeout(8000) });
  if (answer.status === 403) throw new Error("denied");
  return answer;
}
async function act(words) {
  let found = { done: false, text: "the page's program does not answer" };
  try {
    const answer = await fetch("/api/act", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(words) });
    found = await answer.json();
  } catch { /* reported as not done */ }
  toast(found.text, !found.done);
  refresh();
  return found.done;
}
let toastTimer = 0;
function toast(text, bad) {
  html($("toast"), h(bad ? "div.bad" : "div", null, text.charAt(0).toUpperCase() + text.slice(1)));
  clearTimeout(toastTimer);
  toastTimer = setTimeout(() => $("toast").replaceChildren(), bad ? 8000 : 3500);
}
function ask(title, text, yes) {
  put($("dialog-title"), title); put($("dialog-text"), text); put($("dialog-yes"), yes);
  $("dialog").returnValue = "no";
  $("dialog").showModal();
  return new Promise((done) => $("dialog").addEventListener("close", () => done($("dialog").returnValue === "yes"), { once: true }));
}

let asking = false;
async function refresh() {
  if (asking) return;
  asking = true;
  try {
    const answer = await get(`/api/state?known=${known}`);
    const text = await answer.text();
    role = answer.headers.get("Page-Role") || role;
    lastAnswer = Date.now();
    if (text) {
      const first = !state;
      state = JSON.parse(text); known = answer.headers.get("Page-Version");
      if (first && !state.has_bridge && !asked) show("sessions");
    }
    lost(false);
    if (state) draw();
  } catch (error) {
    const since = lastAnswer ? `What you see is from ${new Date(lastAnswer).toLocaleTimeString("en-GB")}.` : "";
    put($("lost"), error.message === "denied"
      ? "This link is no longer valid: open the link that the program printed."
      : `The program behind this page does not answer. ${since}`);
    lost(true);
  } finally { asking = false; }
}
/* What is old must not look as if it were of now. */
function lost(yes) {
  $("lost").hidden = !yes;
  document.body.classList.toggle("stale", yes);
  if (isLost !== yes) { isLost = yes; if (state) draw(); }
}
setInterval(() => { if (!document.hidden || Date.now() - lastAnswer > 5000) refresh(); }, 500);
document.addEventListener("visibilitychange", refresh);

// ── views ─────────────────────────────────────────────────────────────────────────────────────────────────────

function show(name, focus) {
  view = VIEWS.includes(name) ? name : "now";
  for (const each of VIEWS) {
    $(each).hidden = each !== view;
    const tab = $("tab-" + each);
    tab.setAttribute("aria-selected", each === view);
    tab.tabIndex = each === view ? 0 : -1;
    if (each === view && focus) tab.focus();
  }
  if (location.hash !== "#" + view) scrollTo(0, 0);
  history.replaceState(null, "", "/#" + view);
  document.title = `${$("tab-" + view).firstChild.textContent.trim()} – igtl-gateway`;
  if (view === "sessions" || view === "replay") loadSessions();
  if (state) draw();
}
for (const each of VIEWS) $("tab-" + each).addEventListener("click", () => show(each));
$("tabs").addEventListener("keydown", (event) => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (step) show(VIEWS[(VIEWS.indexOf(view) + step + VIEWS.length) % VIEWS.length], true);
});
$("pill").addEventListener("click", () => show("recording"));
$("playing").addEventListener("click", () => show("replay"));
document.querySelector(".brand").addEventListener("click", (event) => { event.preventDefault(); show("now"); });
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || /INPUT|SELECT|TEXTAREA/.test(document.activeElement.tagName) || $("dialog").open) return;
  if (event.key >= "1" && event.key <= "4") show(VIEWS[event.key - 1], true);
  if (event.key.toLowerCase() === "m" && state?.bridge) { event.preventDefault(); pressedM = performance.now(); show("recording"); $("mark-label")?.focus(); }
});

const bridge = () => state.bridge;
const locked = () => role !== "full";
function button(text, onclick, { kind = "", off = "", key = text, ...more } = {}) {
  return h(`button.btn${kind}`, { type: "button", onclick, disabled: Boolean(off) || locked(), title: locked() ? "This link is read-only" : off || null, "data-key": key, ...more }, text);
}

let listed = "";
function draw() {
  const now = bridge(), rec = now?.recording;
  $("role").hidden = !locked();
  const wrong = state.wrong;
  $("badge").hidden = !wrong; put($("badge"), String(wrong)); $("badge").setAttribute("aria-label", `${wrong} to check`);
  drawTrouble(rec);
  const files = JSON.stringify([rec?.written, rec?.paused, rec?.files]);  // what the list shows of the bridge
  if (files !== listed) { listed = files; if (view === "sessions" || view === "replay") loadSessions(); }
  const pill = $("pill");
  pill.hidden = !state.has_bridge;
  const [dot, word] = recState();
  const lasted = rec && !rec.rests && !rec.failure && !rec.stands && !isLost && clock(rec.lasted_s);
  part(pill, [dot, word, lasted], () => [h("span.dot." + dot), h("span", null, word), lasted && h("span.sub", null, lasted)]);
  const playing = state.replay?.running && !isLost ? state.replay : null;
  $("playing").hidden = !playing;
  const opens = playing && playing.state.duration_s == null, at = playing && moment(Math.floor(playing.state.position_s || 0)).slice(0, -3);
  part($("playing"), playing && [playing.state.paused, opens, at], () => (!playing ? [] : opens ? [h("span", null, "Replay opens")] : [h("span", { "aria-hidden": "true" }, playing.state.paused ? "❚❚" : "▶"), h("span", null, "Replay"), h("span.sub", null, at)]));
  put($("foot"), state.has_bridge ? (now ? `igtl-gateway ${now.version} · runs for ${span(now.uptime_s)}` : `igtl-gateway ${state.version}`) : `igtl-gateway ${state.version} · ${state.folder}`);
  ({ now: drawNow, recording: drawRecording, sessions: drawSessions, replay: drawReplay })[view]();
}
/* Times, s, below which a disk is soon full, and very soon. */
const LOW_S = [1800, 300];
function lasting(seconds) { return seconds < 120 ? `${number(Math.max(0, seconds))} s` : `${number(seconds / 60)} min`; }
/* What is wrong with the recording, on top of every view. */
function trouble(rec) {
  if (!rec || isLost) return [];
  if (rec.failure) return ["error", `${sentence(rec.failure)} ${rec.snapshot_s ? "It is tried again when a file is due." : rec.rests ? "Messages go on passing, but nothing is recorded. Start begins the next file." : "Nothing more is recorded."}`];
  if (rec.stands) return ["error", "Nothing is written: the disk does not answer, or the recorder has no processor. Messages go on passing and wait in memory; what it has no room for is not recorded."];
  if (rec.losing) return ["error", "The recording is too slow: messages are missing in it, and more are being lost. Its note has the cause."];
  if (rec.taken_away) return ["warning", sentence(rec.taken_away)];
  if (rec.left_s != null && rec.left_s < LOW_S[0] && !rec.rests) return [rec.left_s < LOW_S[1] ? "error" : "warning", `The disk of the recording is full in ${lasting(rec.left_s)} at the present rate: ${bytes(rec.free ?? 0)} are free in ${rec.folder}. Free some space, pause, or stop.`];
  return rec.paused && !rec.rests && view !== "recording" ? ["warning", "The recording is paused: nothing is recorded but marks, until Resume is pressed."] : [];
}
function drawTrouble(rec) {
  const [kind, text] = trouble(rec), at = $("trouble");
  at.hidden = !text; at.className = `lost s-${kind}`;
  part(at, [kind, text], () => (text ? [icon(kind), " ", text] : []));
}
function recState() {
  const now = bridge(), rec = now?.recording;
  if (isLost || (state.has_bridge && !state.answers)) return ["fail", "No answer"];
  if (!rec) return ["off", "Not recording"];
  if (rec.failure) return ["fail", rec.snapshot_s ? "Cannot save" : "Recording failed"];
  if (rec.stands) return ["fail", "Disk does not answer"];
  if (rec.rests) return ["off", "Not recording"];
  if (rec.paused) return ["paused", "Paused"];
  return ["rec", rec.snapshot_s ? `Keeps ${number(rec.snapshot_s)} s` : "Recording"];
}

/* A place for each part of a view, made once. */
function places(section, ...names) {
  if (!section._places) {
    section._places = Object.fromEntries(names.map((name) => [name, h("div")]));
    section.append(...Object.values(section._places));
  }
  return section._places;
}
function card(title, more, ...body) {
  return h("div.card", null, h("div.head", null, h("h2", null, title), more && h("span.more", null, more)), ...body);
}

/* A table whose rows stay the same elements: only what has changed is written. */
class Rows {
  constructor(columns, cells, label) {
    this.cells = cells; this.rows = new Map(); this.columns = columns.length; this.titles = columns.map(([title]) => title);
    this.body = h("tbody");
    this.element = h("div.scroll", { tabindex: 0, role: "region", "aria-label": label }, h("table", null, h("thead", null, h("tr", null, columns.map(([title, kind]) => h("th", { scope: "col", class: kind }, title)))), this.body));
  }
  draw(rows) {
    const order = [], gone = new Set(this.rows.keys());
    for (const row of rows) {
      gone.delete(row.key);
      let made = this.rows.get(row.key);
      if (!made) {
        this.rows.set(row.key, made = { cells: this.cells(), why: null });
        made.cells.forEach((cell, at) => { cell.td.dataset.label = this.titles[at]; });
      }
      made.tr ||= h("tr", null, made.cells.map((cell) => cell.td));
      for (const cell of made.cells) cell.draw(row);
      const kind = row.state === "ok" ? "" : `row-${row.state}`;
      const pair = row.text ? `${kind} pair` : kind;
      if (made.tr.className !== pair) made.tr.className = pair;
      order.push(made.tr);
      if (row.text) {
        made.why ||= h("tr", null, h("td", { colspan: this.columns }, h("b"), h("span")));
        made.why.className = `why ${kind}`;
        const [text, advice] = made.why.firstChild.children;
        put(text, sentence(row.text)); advise(advice, row.advice ? " " + sentence(row.advice) : "");
        order.push(made.why);
      }
    }
    for (const key of gone) this.rows.delete(key);
    const same = order.length === this.body.children.length && order.every((tr, at) => this.body.children[at] === tr);
    if (!same) this.body.replaceChildren(...order);
  }
}
/* `words` of an advice are code. */
function advise(place, text) {
  if (place._shown !== text) html(place, ...(place._shown = text).split("`").map((each, at) => (at % 2 ? h("code", null, each) : each)));
}
function sentence(text) { return text.charAt(0).toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? "" : "."); }
function textCell(kind, shown) { const td = h("td", { class: kind }); return { td, draw: (row) => { const [text, zero] = [shown(row)].flat(); put(td, text); td.classList.toggle("zero", Boolean(zero)); } }; }
function stateColumn() { const td = h("td"); let last = ""; return { td, draw: (row) => { const word = row.left_ns ? "left" : row.word || WORDS[row.state]; if (row.state + word !== last) { last = row.state + word; html(td, stateCell(row.state, word)); } } }; }
function sparkColumn() {
  const path = svg("path", {}), td = h("td.wide", null, svg("svg", { class: "spark", viewBox: "0 0 100 22", preserveAspectRatio: "none", "aria-hidden": "true" }, path));
  let last = "";
  return { td, draw: (row) => { if (row.spark !== last) path.setAttribute("d", sparkline(last = row.spark)); } };
}

const TO = { igtl: (place) => `, at ${place}`, ros: () => ", to ROS 2", both: (place) => `, at ${place} and to ROS 2` };
let links, streams;
function drawNow() {
  const at = places($("now"), "lead", "links", "streams", "plot", "pictures", "notes"), now = bridge();
  if (!now) {
    for (const each of Object.values(at)) part(each, null, () => []);
    links = streams = null; at.plot._open = null;
    part(at.lead, [state.has_bridge, state.answers], () => h("div.card", null, h("p.empty", null, state.has_bridge
      ? (state.answers ? "The bridge has no session: another node configures and activates it." : "The bridge does not answer. It may have stopped.")
      : "This page shows a folder of recordings. For links and streams, start a bridge with --page.")));
    return;
  }
  const wrong = state.wrong, total = now.inputs;
  const worst = [...now.streams, ...now.links].map((row) => row.state).sort((a, b) => STATES.indexOf(a) - STATES.indexOf(b))[0] || "waiting";
  const title = now.headline ? sentence(now.headline).replace(/\.$/, "") : !total ? "No messages yet" : !now.arriving ? "Nothing arrives now" : now.arriving < total ? `${number(now.arriving)} of ${number(total)} streams arrive now` : total === 1 ? "The stream arrives" : `All ${number(total)} streams arrive`;
  const more = now.others && sentence(now.others).replace(/\.$/, "");
  const playing = state.replay?.running ? `A replay runs: ${state.replay.name}${TO[state.replay.to](state.replay.place)}` : "";
  part(at.lead, [title, more, worst, total, now.arriving, now.links.length, now.ros, now.relay, now.refused, now.slowest, playing], () => h("div.lead", null, icon(total || wrong ? worst : "waiting"), h("div", null, h("h1", null, title),
    h("p", null, [more, count(now.links.filter((link) => link.link).length, "peer"), count(total, "stream"), now.relay ? "relay" : now.ros ? "with ROS 2" : "without ROS", now.refused ? `${number(now.refused)} messages refused` : "nothing refused"].filter(Boolean).join(" · ")),
    now.slowest.length ? h("p", null, sentence(now.slowest.join(" · ")).replace(/\.$/, "")) : null,
    playing ? h("p", null, playing) : null)));
  if (!links) {
    links = new Rows([["State"], ["Peer"], ["Since", "n wide"], ["Rate", "n"], ["Last minute", "wide"], ["Latency", "n"], ["Jitter", "n wide"], ["Queue", "n"], ["Dropped", "n"]], () => [
      stateColumn(), twoLines((row) => row.name || row.peer, (row) => [`${row.role}${row.name ? ` ${row.peer}` : ""}`, row.profile !== "unrecognised" && row.profile, row.clock && `clock ${row.clock}`].filter(Boolean).join(" · ")),
      textCell("n wide", (row) => (row.left_ns ? `left ${time(row.left_ns)}` : row.since_ns ? time(row.since_ns) : [NONE, true])), ratesCell(), sparkColumn(),
      latencyCell(), textCell("n wide", (row) => (row.jitter_ms == null ? [NONE, true] : `${number(row.jitter_ms, 2)} ms`)),
      textCell("n", (row) => (row.queue || !row.stuck_bytes ? [number(row.queue), !row.queue] : bytes(row.stuck_bytes))), textCell("n", (row) => [number(row.dropped), !row.dropped])], "Links");
    const nothing = h("p.empty", null, "No peer is connected.");
    at.links._nothing = nothing;
    html(at.links, card("Links", null, links.element, nothing));
    streams = new Rows([["State"], ["Stream"], ["Rate", "n"], ["Last minute", "wide"], ["Last", "n"], ["Worst gap", "n"], ["Latency", "n"], ["Dropped", "n"], ["Stamps", "wide"]], () => [
      stateColumn(), twoLines((row) => row.name, (row) => [row.type.split("/").pop(), row.way].filter(Boolean).join(" "), (row) => `${row.type} ${row.way}`), textCell("n", (row) => (row.rate_hz ? `${rate(row.rate_hz)} Hz` : [NONE, true])), sparkColumn(),
      textCell("n", (row) => age(row.age_s)), gapCell(), latencyCell(), textCell("n", (row) => [number(row.dropped), !row.dropped]), textCell("wide", (row) => row.stamps || [NONE, true])], "Streams");
    at.streams._more = h("span.more");
    at.streams._nothing = h("p.empty", null, "No stream has arrived yet.");
    html(at.streams, h("div.card", null, h("div.head", null, h("h2", null, "Streams"), at.streams._more), streams.element, at.streams._nothing));
  }
  links.draw(now.links); streams.draw(now.streams);
  links.element.hidden = !now.links.length; at.links._nothing.hidden = Boolean(now.links.length);
  streams.element.hidden = !now.streams.length; at.streams._nothing.hidden = Boolean(now.streams.length);
  put(at.streams._more, now.more ? `${number(now.more)} more are not shown` : now.unsent ? `${count(now.unsent, "topic")} for ROS not shown: ${now.relay ? "a relay has no ROS" : "start without --no-ros to publish them"}` : "what is wrong is on top");
  drawCurve(at.plot, now.streams);
  drawPictures(at.pictures, now.pictures);
  part(at.notes, now.notes, () => card("Notes of the session", null, now.notes.length ? h("ul.notes", { tabindex: 0, "aria-label": "Notes" }, [...now.notes].reverse().map(note)) : h("p.empty", null, "No notes yet.")));
}
function note(each) {
  const kind = { ERROR: "error", WARN: "warning" }[each.level] || "off";
  return h("li", null, h("time", null, time(each.time_ns)), icon(kind), h("span", null, each.text + (each.more ? ` (${number(each.more)} more like it)` : "")));
}
function twoLines(first, second, whole = second) {
  const name = h("span.name.clip"), more = h("span.sub.clip"), td = h("td", null, name, h("br"), more);
  return { td, draw: (row) => { put(name, first(row)); put(more, second(row)); name.title = first(row); more.title = whole(row); } };
}
/* Messages from a peer, and to it. */
function ratesCell() {
  const lines = [h("div"), h("div")], td = h("td.n", null, lines);
  const shown = (word, value) => (value ? `${word} ${number(value, value < 9.95 ? 1 : 0)} /s` : "");
  return { td, draw: (row) => {
    put(lines[0], shown("from", row.from_hz)); put(lines[1], shown("to", row.to_hz) || (row.from_hz ? "" : "0 /s"));
    lines[1].className = row.to_hz ? "" : "zero";
  } };
}
function latencyCell() {
  return textCell("n", (row) => (row.latency_ms != null ? `${number(row.latency_ms, 1)} ms` : row.ahead_ms ? `clock +${milliseconds(row.ahead_ms)}` : [NONE, true]));
}
function milliseconds(value) { return value < 1000 ? `${number(value, 1)} ms` : span(value / 1000); }
function gapCell() {
  const gap = h("span"), when = h("span.sub"), td = h("td.n", null, gap, h("br"), when);
  return { td, draw: (row) => {
    const is_long = row.gap_s >= 1.2;
    put(gap, row.gap_s == null ? NONE : is_long ? span(row.gap_s) : "≤ 1 s"); put(when, is_long && row.gap_utc_ns ? `until ${time(row.gap_utc_ns)}` : "");
    td.classList.toggle("zero", !is_long);
  } };
}
/* The plot of a stream that arrives: null before a person asks for it, then what the program has of the last minute. */
let curve = null, curveBusy = false;
async function readCurve() {
  if (!curve || curveBusy || view !== "now" || document.hidden || isLost) return;
  curveBusy = true;
  const [side, stream, field] = curve.asked;
  try {
    const found = await (await get(`/api/curve?side=${side}&stream=${encodeURIComponent(stream)}&field=${encodeURIComponent(field)}`)).json();
    if (curve && curve.asked[0] === side && curve.asked[1] === stream && curve.asked[2] === field) {
      curve.found = found;
      if (found.times.length > 9) curve.asked[2] = found.field;  // the one that changed stays
    }
  } catch { /* the banner says it */ }
  curveBusy = false;
  if (state && curve) drawNow();
}
setInterval(readCurve, 500);
function askCurve(key, field) {
  const [side, ...name] = key.split(" ");
  const found = curve && curve.key === key ? curve.found : null;
  curve = { key, asked: [side, name.join(" "), field], found };
  readCurve(); drawNow();
}
/* The input that comes most often and has numbers as a rule. */
function usualStream(rows) {
  const coming = rows.filter((row) => row.rate_hz && !/^(IMAGE|VIDEO|POLYDATA|STRING|STATUS)|(Image|PointCloud2|Volume|String)$/.test(row.type)).sort((a, b) => b.rate_hz - a.rate_hz);
  return (coming.find((row) => row.side.endsWith("_in")) || coming[0] || rows[0]).key;
}
function drawCurve(at, rows) {
  const known = rows.filter((row) => !row.key.startsWith("missing ")), found = curve?.found;
  const names = known.map((row) => [row.key, `${row.name} (${[row.type.split("/").pop().replace(/,$/, ""), row.way].filter(Boolean).join(" ")})`]).sort((a, b) => a[1].localeCompare(b[1]));
  if (!curve) {
    at._open = null;
    part(at, ["closed", Boolean(names.length)], () => (names.length ? card("Plot", null, h("div.body", null, h("div.actions", null, h("button.btn", { type: "button", "data-key": "curve", onclick: () => askCurve(usualStream(known), "") }, "Plot a number as it comes"), h("span.sub", null, "any number of any stream, by its name")))) : []));
    return;
  }
  if (!at._open) {
    at._open = [h("div"), h("div")]; at._shown = "";
    html(at, h("div.card", null, h("div.head", null, h("h2", null, "Plot"), h("span.more", null, "up to 20 messages a second")), h("div.body", null, at._open)));
  }
  const [form, box] = at._open, field = found?.field || curve.asked[2], fields = found?.fields || [];
  if (!names.some(([key]) => key === curve.key)) names.push([curve.key, curve.asked[1]]);
  part(form, [names, curve.key, fields, field], () => h("div.form.fields", null, choice("Stream", "curve stream", names, curve.key, (each) => askCurve(each, "")),
    choice("Number", "curve field", fields.map((each) => [each, each]), field, (each) => askCurve(curve.key, each)),
    h("div.actions", null, h("button.btn", { type: "button", "data-key": "curve close", onclick: () => { curve = null; drawNow(); } }, "Close"))));
  const times = found?.times || [], values = found?.values || [];
  part(box, [times, values, field, found?.problem, Boolean(found)], () => [found?.problem ? h("p.sends.s-warning", null, sentence(found.problem)) : null,
    plotBox(times.map((each) => each + (found?.span_s || 0)), values, found?.span_s, `${field} of ${curve.asked[1]}`, [`${found?.span_s} s ago`, field, "now"])
    || h("p.empty", null, !found ? "Reading …" : fields.length ? "No number has come in the last minute." : times.length ? "This stream has no numbers." : "Waiting for its next message.")]);
}
function choice(title, key, all, now, change, off) {
  return h("label.field", null, h("span", null, title), h("select", { "data-key": key, disabled: off ? true : null, onchange: (event) => change(event.target.value) }, all.map(([value, text]) => h("option", { value, selected: value === now }, text))));
}
/* A plot of numbers over seconds from 0 to `duration`, with what is below it; null without numbers. */
function plotBox(times, values, duration, name, below) {
  const known = values.filter((each) => each != null), low = Math.min(...known), high = Math.max(...known);
  if (!known.length) return null;
  return h("div.plot", { role: "img", "aria-label": `${name}: ${short(low)} to ${short(high)}` }, h("span.high", null, short(high)), high > low && h("span.low", null, short(low)),
    svg("svg", { viewBox: "0 0 1000 220", preserveAspectRatio: "none", "aria-hidden": "true" }, svg("path", { class: "curve", d: plotLine(times, values, duration, low, high) }), svg("path", { class: "now", d: "" })),
    h("div.times", null, below.map((each) => h("span", null, each))));
}
function drawPictures(at, pictures) {
  const names = pictures.map(([side, stream]) => [side, stream]);
  part(at, names, () => (names.length ? card("Pictures", "the last one of each stream", h("div.body", null, h("div.pictures", null, pictures.map(([, stream]) => h("figure", null, h("img", { alt: `Last picture of ${stream}` }), h("figcaption", null, stream.replace("IMAGE/", ""))))))) : []));
  const images = at.querySelectorAll("img");
  pictures.forEach(([side, stream, version], number) => {
    const image = images[number], source = `/api/picture?side=${side}&stream=${encodeURIComponent(stream)}&version=${version}`;
    if (image && image.dataset.source !== source) { image.dataset.source = source; image.src = source; }
  });
}

// ── recording ─────────────────────────────────────────────────────────────────────────────────────────────────

function drawRecording() {
  const at = places($("recording"), "state", "work"), now = bridge(), rec = now?.recording;
  if (!now || !rec) {
    part(at.state, ["none", Boolean(now), state.has_bridge], () => h("div.card", null, h("p.empty", null, now ? ["This bridge has no file to record to. Start it with ", h("code", null, "--record FILE"), ", or with ", h("code", null, "--record FILE --record-wait"), " and press Start here."] : state.has_bridge ? "The bridge does not answer." : "This page shows a folder of recordings. To record, start a bridge with --record FILE --page.")));
    part(at.work, [Boolean(now), locked()], () => (now ? [markCard()] : []));
    if (now) drawMarkButtons(null);
    return;
  }
  const [dot, word] = recState();
  if (at.state._kind !== "recording") { at.state._kind = "recording"; html(at.state, h("div.card", null, h("div.body"), h("dl.facts", { class: "facts" }), h("div.body"))); }
  const [hero, facts, buttons] = at.state.firstChild.children;
  const paused = dot === "paused";
  part(hero, [dot, word, rec.name, rec.folder, rec.failure, rec.rests, rec.last, clock(rec.lasted_s)], () => h(paused ? "div.hero.loud" : "div.hero", null, h("span.dot." + dot), h("div", null, h("h1", null, paused ? "Paused: nothing is recorded" : word), h("p.sub", null, rec.rests ? `Messages pass. Start writes them to a file in ${rec.folder}` : `${rec.name} in ${rec.folder}`)), rec.rests && rec.last && h("button.btn.link", { type: "button", "data-key": "last", onclick: () => { opened = rec.last; filter = ""; if ($("filter")) $("filter").value = ""; show("sessions", true); } }, `Show ${rec.last} in Sessions`), !rec.rests && !rec.failure && h("span.clock", { "aria-label": "duration" }, clock(rec.lasted_s))));
  const short = rec.lasts_s != null && rec.lasts_s < 3600;
  part(facts, [rec.bytes, rec.files, rec.per_s, rec.free, rec.lasts_s, rec.dropped, rec.entries, rec.left_out, rec.rests, paused, rec.sealed, rec.triggers], () => [
    fact(rec.snapshot_s ? "Saved" : "Size", rec.snapshot_s ? count(rec.files, "file") : bytes(rec.bytes), rec.snapshot_s ? bytes(rec.bytes) : rec.per_s ? `${bytes(rec.per_s)} per second` : rec.files ? count(rec.files, "file") : "nothing is written"),
    rec.free == null ? fact("Disk", "not found", "the folder is gone", "error") : rec.free < 10e6 ? fact("Disk", bytes(rec.free), rec.free < 1e5 ? "the disk is full" : "the disk is almost full", "error") : fact("Disk", paused || rec.lasts_s == null ? bytes(rec.free) : `lasts ${rec.lasts_s > 365 * 86400 ? "more than a year" : span(rec.lasts_s)}`, paused || rec.lasts_s == null ? "free" : `${bytes(rec.free)} free`, short && "warning"),
    fact("Losses", rec.dropped ? number(rec.dropped) : "none", rec.dropped ? "messages are missing" : rec.rests ? "no file is open" : paused ? "before the pause" : "every message is kept", rec.dropped && "error"),
    fact("Messages", number(rec.entries), rec.rests ? (rec.entries ? "in the last file" : "nothing is written yet") : rec.left_out ? `in this file; ${number(rec.left_out)} more in pauses or not chosen` : rec.split ? "in the files of this recording" : "in this file"),
    fact("Seal", rec.sealed ? "on" : "off", rec.sealed ? "each change will show" : "--seal KEY signs it"),
    ...(rec.triggers.length ? [fact("Black box", count(rec.triggers.length, "rule"), rec.triggers.join(", "))] : [])]);
  const takes = !rec.snapshot_s && (!rec.failure || rec.rests);
  /* Each button keeps its place: a second click on it does nothing else. */
  const rests = rec.rests && "Nothing is recorded", resumes = rec.paused && !rec.rests;
  part(buttons, [rec.paused, rec.rests, rec.snapshot_s, rec.split, takes, locked()], () => h("div.actions", null,
    takes && (resumes ? button("Resume", () => press("resume"), { kind: ".big.primary.first", key: "start" }) : button("Start recording", () => press("start"), { kind: rests ? ".big.primary.first" : ".big.first", key: "start", off: !rests && "It is recorded already" })),
    takes && button("Pause", () => press("pause"), { kind: ".big", key: "pause", off: rests || (resumes && "It is paused already") }),
    Boolean(rec.snapshot_s) && button(`Save the last ${number(rec.snapshot_s)} s`, () => act({ do: "snapshot" }), { kind: ".big.primary" }),
    takes && rec.split && button("New file", () => press("split"), { kind: ".big", off: rests }),
    takes && button("Stop recording …", async () => { stopRecording(); }, { kind: ".big", key: "stop", off: rests }),
    h("span.gap"),
    button("Shut down the bridge …", async () => { if (await ask("Shut down the bridge?", "The recording is closed, all peers are disconnected, and this page ends.", "Shut down")) act({ do: "end" }); }, { kind: ".danger" })));
  drawMarks(at.work, rec, now);
}
/* A double click is one press. */
const pressedAt = {};
function press(what) {
  const before = pressedAt[what] || 0;
  pressedAt[what] = Date.now();
  if (pressedAt[what] - before > 1000) act({ do: what });
}
async function stopRecording() {
  const open = bridge().recording.phases, ends = open.length ? ` The open ${open.length > 1 ? "phases end" : "phase ends"} here: ${open.join(", ")}.` : "";
  if (!(await ask("Stop the recording?", `Its file is closed. Messages go on passing, and Start begins the next file.${ends}`, "Stop"))) return;
  for (const label of bridge().recording.phases) if (!(await act({ do: "mark", line: `-${label}` }))) return;
  act({ do: "stop" });
}
function fact(title, value, more, kind) { return h("div", { class: kind ? "s-" + kind : "" }, h("dt", null, title), h("dd", null, value, h("small", null, more))); }

/* Why a mark would be lost; "" if it is recorded. */
function lostMark(rec) {
  if (!rec) return "This bridge has no file: nothing is recorded";
  if (rec.snapshot_s) return "";
  return rec.rests ? "Nothing is recorded: press Start first" : rec.failure ? "The recording has failed: nothing is recorded" : "";
}
/* When M was pressed: the time of a mark that Enter ends, because a person writes for some seconds; null: not. */
let pressedM = null;
async function mark(sign, since = null) {
  const label = $("mark-label").value.trim(), text = $("mark-text").value.trim(), why = lostMark(bridge()?.recording);
  if (why) { toast(why, true); return; }
  if (!label) { $("mark-label").focus(); toast("write a label first, such as suture-1", true); return; }
  const ago_s = since == null ? 0 : (performance.now() - since) / 1000;
  if (await act({ do: "mark", line: `${sign}${label}${text ? ": " + text : ""}`, ago_s })) { pressedM = null; $("mark-label").value = $("mark-text").value = ""; document.activeElement.blur(); }
}
function drawMarkButtons(rec) {
  const off = lostMark(rec), more = $("mark-more");
  const since = pressedM == null ? "its time is that of Enter or the button; recorded also in a pause" : `Enter marks ${time((performance.timeOrigin + pressedM) * 1e6)}, when M was pressed; a button marks now`;
  put(more, off || since); more.classList.toggle("s-warning", Boolean(off));
  part($("mark-actions"), [off, locked()], () => [button("Mark this moment", () => mark(""), { kind: ".primary", off }), button("Begin a phase", () => mark("+"), { off })]);
}
function markCard() {
  const enter = (event) => { if (event.key === "Enter") mark("", pressedM); if (event.key === "Escape") { pressedM = null; event.target.blur(); draw(); } };
  const off = locked();
  return card("Mark", h("span", { id: "mark-more" }), h("div.body", null,
    h("div.form", null,
      h("label.field", null, h("span", null, "Label"), h("input", { type: "text", id: "mark-label", maxlength: 64, placeholder: "short name", autocomplete: "off", onkeydown: enter, disabled: off, list: "labels" })),
      h("label.field", null, h("span", null, "Text"), h("input", { type: "text", id: "mark-text", maxlength: 1000, placeholder: "what happens (optional)", autocomplete: "off", onkeydown: enter, disabled: off }))),
    h("div.actions", { id: "mark-actions" }),
    h("div", { id: "phases" })));
}
function drawMarks(at, rec, now) {
  const [left, right] = at._two || (at._two = [h("div"), h("div")]);
  if (at._kind !== "marks") { at._kind = "marks"; at._shown = ""; html(at, h("div.split", null, left, right)); }
  part(left, [locked()], () => [markCard()]);
  drawMarkButtons(rec);
  const phases = $("phases");
  part(phases, [rec.phases, locked()], () => (rec.phases.length ? h("div.phases", null, "Open phases:", rec.phases.map((label) => button(`End “${label}”`, () => act({ do: "mark", line: `-${label}` }), { kind: ".small" }))) : []));
  const marks = now.done;
  part(right, [marks, lostMark(rec)], () => card("What was done", null, marks.length ? h("ul.notes", { tabindex: 0, "aria-label": "What was done" }, [...marks].reverse().map(note)) : h("p.empty", null, lostMark(rec) ? "No marks yet." : "No marks yet. Press M anywhere on this page.")));
}

// ── sessions ──────────────────────────────────────────────────────────────────────────────────────────────────

let sessions = null, opened = "", filter = "", sessionsTimer = 0, openJob = 0;
async function loadSessions() {
  try { sessions = await (await get("/api/sessions")).json(); } catch { /* the banner says it */ }
  if (state) draw();
  clearTimeout(sessionsTimer);
  const busy = sessions?.some((row) => !row.read) || state?.jobs.some((job) => job.state === "running");
  if (view === "sessions" || view === "replay") sessionsTimer = setTimeout(loadSessions, busy ? 700 : 3000);
}
const ACTIONS = [["verify", "Verify"], ["lint", "Find problems"], ["review", "Review"], ["view", "Open in rerun"], ["export", "Export as CSV"], ["scene", "Export for 3D Slicer"], ["seal", "Check the seal"]];
/* Names of the machine of the program, where the viewer's link leads somewhere. */
const HERE = new Set(["127.0.0.1", "localhost", "[::1]"]);
const RESULTS = { running: ["waiting", "runs"], done: ["ok", "good"], failed: ["error", "not good"], cancelled: ["off", "cancelled"], nothing: ["off", "not applicable"] };
const RESULTS_OF = { lint: { done: ["ok", "no errors"], failed: ["warning", "problems found"] }, export: { done: ["ok", "done"], failed: ["error", "failed"] }, scene: { done: ["ok", "done"], failed: ["error", "failed"] }, view: { done: ["ok", "done"], failed: ["error", "failed"] } };
function result(row, action, none) {
  const found = row.results[action];
  if (!found) return h("span.result.zero", null, none);
  const job = found === "running" && state.jobs.find((each) => each.state === "running" && each.name === row.name && each.action === action);
  const [kind, usual] = RESULTS[found], word = job?.progress || usual;
  return h("span.result.s-" + kind, { title: found === "nothing" ? "It has no point cloud or no plan" : null }, icon(kind), word);
}
function sessionState(row) {
  if (row.recording) return row.paused ? ["warning", "paused"] : ["waiting", "recording"];
  if (!row.read && !row.closed) return ["waiting", row.reading_s == null ? "to be read" : row.reading_s < 3 ? "reading" : `reading, ${span(row.reading_s)}`];
  if (row.unread) return ["warning", "not read"];
  return row.problem ? ["error", "not closed"] : ["ok", "closed"];
}
function drawSessions() {
  const at = places($("sessions"), "head", "table", "jobs");
  part(at.head, [state.folder], () => h("div.lead", null, h("div", null, h("h1", null, "Sessions"), h("p", null, state.folder || "no folder")), h("span.gap"),
    h("input", { type: "search", placeholder: "Filter by name or mark", "aria-label": "Filter by name or mark", style: null, "data-key": "filter", id: "filter", oninput: (event) => { filter = event.target.value.toLowerCase(); drawSessions(); } })));
  const rows = (sessions || []).filter((row) => !filter || row.name.toLowerCase().includes(filter) || (row.marks || []).some((mark) => mark.label.toLowerCase().includes(filter)));
  part(at.table, [rows, opened, locked(), sessions == null, state.jobs.map((job) => job.progress)], () => h("div.card", null, !rows.length ? h("p.empty", null, sessions == null ? (state.folder ? "Reading the folder …" : "This bridge does not record: there is no folder to list.") : filter ? "No recording matches." : "No recordings in this folder.")
    : h("div.scroll", { tabindex: 0, role: "region", "aria-label": "Recordings" }, h("table", null, h("thead", null, h("tr", null, SESSION_COLUMNS.map(([title, kind]) => h("th", { scope: "col", class: kind }, title)))), h("tbody", null, rows.map(sessionRow)))),
    sessions?.at(-1)?.older && h("p.empty", null, `${number(sessions.at(-1).older)} older recordings are not listed.`)));
  part(at.jobs, [state.jobs, openJob, openJob && jobLines, locked()], () => (state.jobs.length ? card("Work", null, h("ul.jobs", null, state.jobs.map(jobRow))) : []));
}
const SESSION_COLUMNS = [["Recording"], ["Begun", ""], ["Duration", "n"], ["Size", "n"], ["Streams", "n wide"], ["Marks", "n"], ["State"], ["Verified", ""], ["Sealed", "wide"], ["Reviewed", "wide"]];
function sessionRow(row) {
  const open = opened === row.name, [kind, word] = sessionState(row);
  const toggle = () => { opened = open ? "" : row.name; drawSessions(); };
  const tr = h(open ? "tr.pick.opened" : "tr.pick", { onclick: toggle },
    h("td", null, h("button.link", { "data-key": row.name, "aria-expanded": open, "aria-label": row.name }, h("span.middle", { title: row.name }, ...nameParts(row.name)))),
    h("td", null, row.start_ns ? day(row.start_ns) : h("span.zero", { title: "Its begin is not known; this is its last change" }, `until ${day(row.modified_ns)}`)), h("td.n", null, row.duration_s == null ? NONE : row.about ? h("span", { title: "How long it was recorded; the file is being read" }, `about ${span(row.duration_s)}`) : span(row.duration_s)), h("td.n", null, bytes(row.bytes)),
    h("td.n.wide", null, row.streams == null ? NONE : number(row.streams)), h("td.n", { class: row.marks?.length ? "n" : "n zero" }, row.marks ? number(row.marked ?? row.marks.length) : NONE),
    h("td", null, stateCell(kind, word)), h("td", null, result(row, "verify", "not yet")),
    h("td.wide", null, row.results.seal ? result(row, "seal") : h("span", { class: row.sealed ? "" : "zero" }, row.sealed ? "has a seal" : "no")), h("td.wide", null, result(row, "review", "not yet")));
  [...tr.children].forEach((td, at) => { td.dataset.label = SESSION_COLUMNS[at][0]; });
  if (!open) return tr;
  const off = row.recording ? "It is being recorded" : "";
  return [tr, h("tr.open", null, h("td", { colspan: 10 },
    row.problem && (row.unread ? h("p.sub", null, `${sentence(row.problem)} It is tried again by itself; all that is below works meanwhile.`) : h("p.s-error", null, row.problem)),
    h("div.actions", null, ACTIONS.map(([action, title]) => button(title, () => act({ do: "job", action, name: row.name }).then(loadSessions), { off, kind: "", key: `${row.name} ${action}` })),
      h("span.gap"), button("Replay …", () => { choose(row.name); show("replay"); }, { kind: ".primary", off, key: `${row.name} replay` })),
    row.marks?.length ? h("div.phases", null, "Marks:", row.marks.slice(0, 24).map((mark) => h("button.btn.small", { type: "button", disabled: locked(), "data-key": `${row.name} ${mark.label} ${mark.time_ns}`, onclick: () => { choose(row.name, markTime(mark, row)); show("replay"); } }, `${mark.label} ${moment(markTime(mark, row))}`)), row.marked > 24 && `and ${number(row.marked - 24)} more`) : null))];
}
/* A long name is cut in its middle: its end is what differs. */
function nameParts(name) { return name.length > 26 ? [h("span.head", null, name.slice(0, -12)), h("span", null, name.slice(-12))] : [h("span", null, name)]; }
function markTime(mark, row) { return Math.max(0, (mark.time_ns - row.start_ns) / 1e9); }
let jobLines = [];
async function toggleJob(number) {
  openJob = openJob === number ? 0 : number; jobLines = [];
  await readJob(); drawSessions();
}
async function readJob() { if (openJob) try { jobLines = await (await get(`/api/job?number=${openJob}`)).json(); } catch { /* the banner says it */ } }
setInterval(async () => { if (openJob && view === "sessions") { await readJob(); drawSessions(); } }, 1500);
/* How far something is, in percent; NaN: it is not known. */
function bar(title, percent) {
  const made = h("i"), known = percent >= 0;
  if (known) { made.className = "known"; made.style.width = `${percent}%`; }
  return h("div.bar", { role: "progressbar", "aria-label": title, "aria-valuemin": known ? 0 : null, "aria-valuemax": known ? 100 : null, "aria-valuenow": known ? percent : null }, made);
}
function jobRow(job) {
  const [kind, word] = job.link ? ["ok", "ready"] : RESULTS_OF[job.action]?.[job.state] || RESULTS[job.state], title = ACTIONS.find(([action]) => action === job.action)[1], open = openJob === job.number;
  return h("li", null, h("div.line1", null, icon(kind), h("b", null, title), h("span.clip", { title: job.name }, job.name), h("span.sub", null, [job.progress || word, span(job.seconds)].join(" · ")), h("span.gap"),
    job.link && HERE.has(location.hostname) && h("a.btn.small.primary", { href: job.link, target: "_blank", rel: "noopener noreferrer" }, "Open the viewer"),
    h("button.btn.small", { type: "button", "aria-expanded": open, "data-key": `show ${job.number}`, onclick: () => toggleJob(job.number) }, open ? "Hide output" : "Show output"),
    job.state === "running" && button("Cancel", () => act({ do: "cancel", number: job.number }), { kind: ".small.danger", key: `cancel ${job.number}` })),
    job.link && !HERE.has(location.hostname) && h("p.sub", null, "The viewer listens only on the machine that has the recordings: there, open ", h("code", null, job.link)),
    job.last && !open && h("div.last", null, job.last), job.state === "running" && !job.link && bar(`${title} runs`, parseInt(job.progress, 10)),
    open && h("pre", { tabindex: 0, "aria-label": "Output" }, jobLines.join("\n") || "no output yet"));
}

// ── replay ────────────────────────────────────────────────────────────────────────────────────────────────────

let chosen = "", from = 0, follows = false, placesOf = {}, target = "igtl listen", side = "", speed = "1", place = "";
function choose(name, at) {
  if (chosen !== name) plot = null;
  chosen = name; from = at || 0;
}
/* Asked again until there is an answer: a long recording takes its time. */
async function readPlaces(name) {
  if (name in placesOf) return;
  placesOf[name] = null;
  let found = null;
  try { found = (await (await get(`/api/places?name=${encodeURIComponent(name)}`)).json())?.places; } catch { /* the banner says it */ }
  if (found) placesOf[name] = found; else setTimeout(() => delete placesOf[name], 1000);
  if (state) draw();
}
const steer = (what, value = null) => act2({ do: "steer", steer: what, value });
async function act2(words) {
  try {
    const answer = await fetch("/api/act", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(words) });
    const found = await answer.json();
    if (!found.done) toast(found.text, true);
  } catch { toast("the page's program does not answer", true); }
  refresh();
}
async function begin() {
  const [to, way] = target.split(" ");
  await act({ do: "replay", name: chosen, to, side, role: way || "listen", address: place || usualPlace(), rate: Number(speed), from_s: beginning() });
}
/* Where the replay begins: from the end, again. */
function beginning() {
  const length = (sessions || []).find((row) => row.name === chosen)?.duration_s;
  return from < length - 0.05 ? from : 0;
}
/* Beside a bridge the port of Slicer's connector is often its own. */
function usualPlace() { return state.has_bridge && !target.includes("connect") ? "127.0.0.1:18945" : "127.0.0.1:18944"; }
/* What must be there before the start, and what is lost without it. */
const HINTS = {
  "igtl listen": (at) => `Start makes an OpenIGTLink server at ${at}: let the clients connect to it. What plays while none is connected reaches no client.`,
  "igtl connect": (at) => `An OpenIGTLink server must run at ${at}. What plays while it cannot be reached is lost.`,
  ros: () => "All topics are published as they were recorded, in the ROS domain of this program; nodes that run there get them.",
  "both listen": (at) => `Topics are published as they were recorded, and clients connect to ${at}. What plays while none is connected reaches no client.`,
};
/* The plot of the chosen recording: null before a person asks for it, then what the program has read. */
let plot = null, plotted = "", plotBusy = false;
async function readPlot(stream, field) {
  const name = chosen;
  plotted = name; plotBusy = true; draw();
  try {
    const found = await (await fetch(`/api/plot?name=${encodeURIComponent(name)}&stream=${encodeURIComponent(stream)}&field=${encodeURIComponent(field)}`, { signal: AbortSignal.timeout(90000) })).json();
    if (chosen === name) plot = found || { problem: "the recording is gone" };
  } catch { if (chosen === name) plot = { ...(plot || {}), problem: "the numbers were not read in time" }; }
  plotBusy = false;
  draw();
}
/* Lines that end where a number is missing, or where nothing came for long. */
function plotLine(times, values, duration, low, high) {
  const steps = times.slice(1).map((each, at) => each - times[at]).sort((a, b) => a - b), most = Math.max(1, 5 * (steps[steps.length >> 1] || 0));
  let text = "", before = -1e9;
  times.forEach((each, at) => {
    const value = values[at];
    if (value == null) { before = -1e9; return; }
    const x = (each / duration * 1000).toFixed(1), y = (high > low ? 205 - (value - low) / (high - low) * 190 : 110).toFixed(1);
    text += `${each - before > most ? `M${x} ${y}h.01` : "L" + x + " " + y}`;
    before = each;
  });
  return text;
}
function short(value) { return Math.abs(value) >= 1e6 || (value && Math.abs(value) < 1e-3) ? value.toExponential(3) : number(value, Math.abs(value) >= 100 ? 1 : 3); }
function drawPlot(at, row, duration, position) {
  const mine = plotted === row.name ? plot : null, busy = plotBusy && plotted === row.name;
  part(at, [row.name, mine && [mine.stream, mine.field, mine.streams, mine.problem, mine.times?.length], busy, duration], () => {
    if (!mine) return card("Plot", null, h("div.body", null, busy ? [h("p.wait", null, "The numbers are being read."), bar("Reading", NaN)] : h("div.actions", null, h("button.btn", { type: "button", "data-key": "plot", disabled: row.recording ? true : null, onclick: () => readPlot("", "") }, "Plot a number over time"), h("span.sub", null, "any number of any stream, by its name"))));
    const same = (all) => (all || []).map((each) => [each, each]);
    return card("Plot", mine.every > 1 ? `one in ${number(mine.every)} of ${count(mine.messages, "message")}` : mine.messages ? count(mine.messages, "message") : null, h("div.body", null,
      h("div.form.fields", null, choice("Stream", "plot stream", same(mine.streams), mine.stream, (each) => readPlot(each, ""), busy), choice("Number", "plot field", same(mine.fields), mine.field, (each) => readPlot(mine.stream, each), busy)),
      busy ? bar("Reading", NaN) : null,
      mine.problem ? h("p.sends.s-warning", null, sentence(mine.problem)) : null,
      plotBox(mine.times || [], mine.values || [], duration, `${mine.field} of ${mine.stream}`, [moment(0), mine.field, moment(duration)]) || h("p.empty", null, busy ? "Reading …" : "This stream has no numbers.")));
  });
  at.querySelector(".plot .now")?.setAttribute("d", `M${(position / duration * 1000).toFixed(1)} 0V220`);
}
function drawReplay() {
  const at = places($("replay"), "head", "choice", "player", "plot", "below"), replay = state.replay, running = replay?.running;
  if (running && chosen !== replay.name) choose(replay.name);
  if (running) follows = true;
  else if (follows) { follows = false; if (chosen === replay?.name) from = replay.state.position_s ?? from; }
  part(at.head, [running, replay?.name], () => h("div.lead", null, h("div", null, h("h1", null, running ? `Replay of ${replay.name}` : "Replay"), h("p", null, "Sends again what the bridge sent, or what its peers sent: to OpenIGTLink peers, to ROS, or to both."))));
  const row = (sessions || []).find((each) => each.name === chosen);
  const ready = (sessions || []).filter((each) => each.closed || each.name === chosen || (each.closed == null && !each.recording));
  if (!chosen && ready.length) choose(ready[0].name);
  const title = (each) => (each.closed ? each.name : `${each.name} (${sessionState(each)[1]})`);
  part(at.choice, [ready.map(title), chosen, running, locked(), target, side, row?.sends], () => h("div.card", null, h("div.body", null, h("div.form.fields", null,
    h("label.field", null, h("span", null, "Recording"), h("select", { "data-key": "choose", disabled: running, onchange: (event) => { choose(event.target.value); draw(); } }, ready.map((each) => h("option", { value: each.name, selected: each.name === chosen }, title(each))))),
    h("label.field", null, h("span", null, "Send to"), h("select", { "data-key": "target", disabled: running, onchange: (event) => { target = event.target.value; draw(); } },
      [["igtl listen", "OpenIGTLink clients"], ["igtl connect", "an OpenIGTLink server"], ["ros", "ROS 2"], ["both listen", "OpenIGTLink clients and ROS 2"]].map(([value, title]) => h("option", { value, selected: value === target }, title)))),
    target !== "ros" && h("label.field", null, h("span", null, target.includes("connect") ? "Its address" : "At address"), h("input", { type: "text", "data-key": "place", disabled: running, value: place || usualPlace(), onpointerdown: (event) => { event.target._fresh = document.activeElement !== event.target; }, onclick: (event) => { if (event.target._fresh) event.target.select(); }, oninput: (event) => { place = event.target.value.trim(); drawHint(); } })),
    h("label.field", null, h("span", null, "Messages"), h("select", { "data-key": "side", disabled: running, onchange: (event) => { side = event.target.value; draw(); } },
      SIDES.map(([value, title]) => h("option", { value, selected: value === side }, title)))),
    h("label.field", null, h("span", null, "Rate"), h("select", { "data-key": "speed", disabled: running, onchange: (event) => { speed = event.target.value; } }, ["0.1", "0.25", "0.5", "1", "2", "5", "10"].map((value) => h("option", { value, selected: value === speed }, `${value} ×`))))),
    running ? null : h("p.hint", { id: "hint" }, hint()), running ? null : sends(row)?.map(([kind, text, ...buttons]) => [h("p.sends", { class: kind }, text), buttons.length ? h("div.actions.offers", null, buttons) : null]))));
  const playing = running ? replay.state : null, length = row?.duration_s ?? playing?.duration_s;
  if (!row) {
    at.player._track = null;
    part(at.player, sessions == null, () => h("div.card", null, h("p.empty", null, sessions == null ? "Reading the folder …" : "No recording can be replayed yet. Record one, or start the page in a folder that has some.")));
    part(at.below, null, () => []);
    part(at.plot, null, () => []);
    return;
  }
  drawPlayer(at.player, row, length, playing, replay);
  if (row.duration_s == null) {
    part(at.plot, null, () => []);
    at.below._track = null;
    part(at.below, null, () => []);
    return;
  }
  readPlaces(row.name);
  drawPlot(at.plot, row, Math.max(length ?? 0, 1e-3), playing?.position_s ?? from);
  drawBelow(at.below, row, replay, running);
}
/* What is sent of a recording, in words. */
const SIDES = [["", "the usual ones"], ["gateway", "those of the bridge"], ["peers", "those of peers and nodes"], ["both", "all"]];
/* Which streams go out to the chosen target, which do not, and why; with buttons for what can be done about it. */
function sends(row) {
  const found = row?.sends?.[`${target.split(" ")[0]} ${side}`.trim()];
  if (!found) return null;
  const some = (names, all) => names.map((name) => name.replace(/\/$/, "")).join(", ") + (all > names.length ? ` and ${number(all - names.length)} more` : "");
  const offer = (title, to, messages) => button(title, () => { target = to; side = messages; draw(); }, { kind: ".small", key: `offer ${to} ${messages}` });
  const others = (to) => SIDES.find(([each]) => row.sends[`${to.split(" ")[0]} ${each}`.trim()]?.number);
  const found_elsewhere = ["igtl listen", "ros"].map((to) => [to, others(to)]).filter(([, one]) => one).map(([to, [messages, title]]) => offer(`Send ${title} to ${to === "ros" ? "ROS 2" : "OpenIGTLink clients"}`, to, messages));
  const sent = found.number ? ["", `Sent: ${count(found.number, "stream")}: ${some(found.names, found.number)} (${found.why}).`] : ["s-warning", `Nothing is sent: the recording has no messages for this target.${found_elsewhere.length ? "" : " It has none for any other."}`, ...found_elsewhere];
  return [sent, found.staying && ["s-warning", `Not sent: ${count(found.staying, "stream")} that peers sent to the bridge: ${some(found.stay, found.staying)}.`, offer(found.staying > 1 ? "Send them, too" : "Send it, too", target, "both"), offer(found.staying > 1 ? "Send only what peers sent" : "Send only what the peer sent", target, "peers")]].filter(Boolean);
}
function hint() { return HINTS[target](place || usualPlace()); }
function drawHint() { if ($("hint")) put($("hint"), hint()); }
/* What a person waits for, "" if for nothing. */
function waits(row, playing, replay) {
  const passed = (seconds) => (seconds >= 2 ? ` (${number(seconds)} s so far)` : "");
  if (playing && playing.duration_s == null) return `the recording is opened for the replay${passed(replay.opening_s)}`;
  if (row.duration_s != null) return "";
  if (row.unread) return `the recording was ${row.problem}. It is tried again by itself, and can be replayed all the same`;
  return row.problem ? (row.recording ? "it is being recorded" : row.problem) : `the recording is being read${passed(row.reading_s || 0)}. Its time line follows, and it can be replayed all the same`;
}
function marksOf(row) {
  return (row.marks || []).map((mark) => ({ kind: mark.end_ns == null ? "mark" : "phase", at_s: markTime(mark, row), end_s: mark.end_ns == null ? null : (mark.end_ns - row.start_ns) / 1e9, text: mark.label + (mark.text ? `: ${mark.text}` : "") }));
}
function drawPlayer(at, row, length, playing, replay) {
  const duration = Math.max(length ?? 0, 1e-3), position = playing?.position_s ?? from, paused = playing?.paused ?? true;
  const kind = `${row.name} ${length == null}`;
  if (at._track !== kind) {
    at._track = kind; at._shown = null;
    at._buttons = h("div.transport"); at._wait = h("div"); at._rail = null;
    if (length != null) {
      at._rail = h("div.track", { role: "slider", tabindex: 0, "aria-label": "Position", "aria-valuemin": 0, "data-key": "track" });
      const seek = (event) => { const box = at._rail.getBoundingClientRect(); jump(Math.min(1, Math.max(0, (event.clientX - box.left) / box.width)) * at._duration); };
      at._rail.addEventListener("pointerdown", (event) => { at._rail.setPointerCapture(event.pointerId); seek(event); at._rail.onpointermove = seek; });
      at._rail.addEventListener("pointerup", () => { at._rail.onpointermove = null; });
      at._rail.addEventListener("keydown", (event) => { const step = { ArrowRight: 1, ArrowLeft: -1, PageUp: 10, PageDown: -10 }[event.key]; if (step) { event.preventDefault(); jump(Math.min(at._duration, Math.max(0, at._position + step * Math.max(.1, at._duration / 100)))); } if (event.key === "Home") jump(0); });
    }
    html(at, h("div.card", null, h("div.body", null, at._buttons, at._wait, at._rail, at._rail && legend())));
  }
  at._duration = duration; at._position = position;
  const begins = beginning(), opens = Boolean(playing) && playing.duration_s == null;
  const off = !playing ? "Start the replay first" : opens ? "The recording is being opened" : "", wait = waits(row, playing, replay);
  part(at._buttons, [paused, Boolean(playing), opens, playing?.rate, locked(), begins, length == null, row.recording], () => [
    !playing ? button(begins > 0 ? `▶ Start at ${moment(begins)}` : "▶ Start", begin, { kind: ".primary", off: row.recording ? "It is being recorded" : "", key: "play" })
      : paused ? button("▶ Play", () => steer("play"), { kind: ".primary", off, key: "play" }) : button("❚❚ Pause", () => steer("pause"), { kind: ".primary", off, key: "play" }),
    playing && button("Stop", () => steer("stop"), { kind: ".danger", key: "stop" }),
    button("Step", () => steer("step"), { off: off || (paused ? "" : "Pause first") }), button("Slower", () => steer("rate", playing.rate / 1.25), { off }), button("Faster", () => steer("rate", playing.rate * 1.25), { off }),
    h("span.sub", null, playing?.rate ? `rate ${number(playing.rate, 2)} ×` : ""), h("span.time", null, "")]);
  html(at._buttons.lastChild, ...(length == null ? [] : [moment(position), h("small", null, ` of ${moment(duration)}`)]));
  const busy = opens || (!row.problem && wait);
  part(at._wait, [wait, busy], () => (wait ? [row.problem && !row.unread ? h("p.wait.s-error", null, wait) : h("p.wait", null, sentence(wait)), busy ? h("div.bar", { role: "progressbar", "aria-label": "Reading" }, h("i")) : null] : []));
  if (!at._rail) return;
  at._rail.setAttribute("aria-valuemax", duration.toFixed(2)); at._rail.setAttribute("aria-valuenow", position.toFixed(2)); at._rail.setAttribute("aria-valuetext", `${moment(position)} of ${moment(duration)}`);
  const found = [...marksOf(row), ...(placesOf[row.name] || [])];
  part(at._rail, [found, duration], () => track(found, duration));
  at._rail.querySelector(".played")?.setAttribute("width", `${position / duration * 100}%`);
  at._rail.querySelector(".head")?.setAttribute("x", `${position / duration * 100}%`);
}
function jump(seconds) { from = seconds; if (state.replay?.running) steer("seek", seconds); else draw(); }
function at(seconds, duration) { return `${Math.min(100, Math.max(0, seconds / duration * 100))}%`; }
function shape(kind) {
  if (kind === "loss") return svg("path", { class: "loss", d: "M-4 -4 4 4M4 -4-4 4" });
  if (kind === "finding") return svg("path", { class: "finding", d: "M0-5.5 5.5 4.5H-5.5Z" });
  if (kind === "mark") return svg("path", { class: "flag", d: "M0 8V-8H9L6.5-4.5 9-1H1V8Z" });
  return svg("circle", { class: "linkmark", r: 3.4 });
}
function track(found, duration) {
  const made = svg("svg", { "aria-hidden": "true" }, svg("defs", {}, svg("pattern", { id: "hatch", width: 6, height: 6, patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)" }, svg("rect", { width: 2.4, height: 6, fill: "currentColor", opacity: .45 }))));
  let paused = null, lane = -1e9, busy = -1e9;
  made.append(svg("rect", { class: "rail", x: 0, y: 48, width: "100%", height: 8, rx: 4 }), svg("rect", { class: "played", x: 0, y: 48, width: 0, height: 8, rx: 4 }));
  for (const each of found) {
    if (each.kind === "pause") paused = each.at_s;
    else if (each.kind === "resume" && paused != null) { made.append(svg("rect", { class: "pause", x: at(paused, duration), y: 44, width: at(each.at_s - paused, duration), height: 16 })); paused = null; }
    else if (each.kind === "phase") {
      const within = each.at_s < busy;  // of another phase: a line below its name
      busy = Math.max(busy, each.end_s);
      made.append(svg("rect", { class: "phase", x: at(each.at_s, duration), y: within ? 36 : 26, width: at(each.end_s - each.at_s, duration), height: within ? 6 : 16, rx: 3 }, svg("title", {}, each.text)));
      if (!within && (each.end_s - each.at_s) / duration > .06) made.append(svg("svg", { x: at(each.at_s, duration), width: at(each.end_s - each.at_s, duration), y: 26, height: 16 }, words(each, 8, 12)));
    }
    else if (each.kind === "slow") {
      made.append(svg("rect", { class: "slow", x: at(each.at_s, duration), y: 66, width: at(Math.max(each.end_s - each.at_s, duration / 200), duration), height: 12, rx: 3 }, svg("title", {}, each.text)));
    }
    else if (each.kind !== "resume") {
      const low = each.kind !== "mark", place = svg("svg", { x: at(each.at_s, duration), y: low ? 72 : 17, overflow: "visible" }, shape(each.kind));
      place.firstChild.append(svg("title", {}, each.text)); made.append(place);
      if (!low && (each.at_s - lane) / duration > .1) { made.append(svg("svg", { x: at(each.at_s, duration), y: 0, overflow: "visible" }, each.at_s / duration < .8 ? words(each, 13, 17) : words(each, -5, 17, "end"))); lane = each.at_s; }
    }
  }
  if (paused != null) made.append(svg("rect", { class: "pause", x: at(paused, duration), y: 44, width: at(duration - paused, duration), height: 16 }));
  made.append(svg("rect", { class: "head", x: 0, y: 40, width: 2.5, height: 24, rx: 1 }));
  return made;
}
function words(each, x, y, anchor = "start") {
  const text = svg("text", { x, y, "text-anchor": anchor });
  text.textContent = plain(each.text).split(":")[0].slice(0, 20);
  return text;
}
function legend() {
  return h("div.legend", null, [["mark", "a mark"], ["finding", "a finding: stamps, units, ages"], ["loss", "messages lost"], ["link", "a peer comes or goes"]].map(([kind, word]) => h("span", null, svg("svg", { viewBox: "-8 -8 16 16", class: "track-key", "aria-hidden": "true" }, shape(kind)), word)),
    h("span", null, svg("svg", { viewBox: "0 0 14 14", "aria-hidden": "true" }, svg("rect", { y: 3, width: 14, height: 8, fill: "url(#hatch)" })), "a pause"),
    h("span", null, svg("svg", { viewBox: "0 0 14 14", "aria-hidden": "true" }, svg("rect", { class: "slow", x: 0.5, y: 3, width: 13, height: 8, rx: 2 })), "a peer read too slowly"),
    h("span", null, svg("svg", { viewBox: "0 0 14 14", "aria-hidden": "true" }, svg("rect", { class: "phase", x: 0.5, y: 3, width: 13, height: 8, rx: 2 })), "a phase"));
}
function drawBelow(place, row, replay, running) {
  const found = [...marksOf(row), ...(placesOf[row.name] || [])].filter((each) => each.kind !== "resume").sort((a, b) => a.at_s - b.at_s).slice(0, 200);
  const mine = replay?.name === row.name ? replay : null, peers = running && mine ? mine.state.peers || [] : [];
  const names = { mark: "Mark", phase: "Phase", finding: "Finding", loss: "Loss", slow: "Slow", pause: "Pause", link: "Link" };
  part(place, [found, !placesOf[row.name], mine?.lines, peers, running, mine?.state?.duration_s, mine?.state?.sent, mine?.state?.without_peer, locked()], () => h("div.split", null,
    card("On the time line", placesOf[row.name] ? (row.marked > found.length ? `of ${number(row.marked)} marks, the first` : null) : "findings, losses and pauses are being read", found.length ? h("ul.list", { tabindex: 0, "aria-label": "On the time line" }, found.map((each, number) => h("li", null, h("button", { type: "button", disabled: locked() && running, "data-key": `at ${number}`, onclick: () => jump(each.at_s) }, h("span.at", null, moment(each.at_s)), h("span.sub", null, names[each.kind]), h("span", null, each.text))))) : h("p.empty", null, placesOf[row.name] ? "Nothing but messages." : "Reading …")),
    card("Peers", running && mine ? [`${count(mine.state.sent || 0, "message")} sent`, mine.state.without_peer ? `${number(mine.state.without_peer)} played while no peer was connected` : ""].filter(Boolean).join(" · ") : null, peers.length ? h("ul.list", null, peers.map((each) => h("li", null, icon(each.queued > 50 ? "warning" : "ok"), h("b", null, each.peer), h("span.sub", null, [each.profile !== "unrecognised" && each.profile, `${rate(each.rate_hz)} messages a second`, `${number(each.sent)} sent`, each.queued ? `${number(each.queued)} wait: it reads slowly` : "queue 0"].filter(Boolean).join(" · "))))) : h("p.empty", null, running ? (mine?.to === "ros" ? "Nodes of ROS receive the messages; the page does not count them." : mine && mine.state.duration_s == null ? "Nothing plays yet." : "No OpenIGTLink peer is connected: what plays now reaches nobody.") : "Peers appear when the replay runs."),
      mine?.lines.length ? h("ul.notes", null, mine.lines.map((line) => h("li", null, h("span", null, line.replace(/^[=!] /, ""))))) : null)));
}

const asked = location.hash.slice(1);  // a view that the address names
show(asked);
refresh();
