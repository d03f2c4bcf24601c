// The page: takes the station's messages, keeps the last minutes, draws.
"use strict";
const $ = id => document.getElementById(id);
const KEEP = 9000, PLOT_S = 60, STALE_MS = 1500, OLD_MS = 3000;
const fleet = new Map();
let chosen = null, socket = null, dirty = true, receivedAt = 0;
const map = new FieldMap($("map"));
map.moved = () => { dirty = true; };
const alarm = new Alarm($("sound"));
let position = null;

function payload(name) {
  if (!fleet.has(name)) {
    fleet.set(name, { name, targets: new Map(), ownTrail: [], own: null, health: null, link: null, events: [], thumb: null, image: new Image(), datum: null, home: null, clock: null });
    if (!chosen) chosen = name;
    tabs();
  }
  return fleet.get(name);
}

function tabs() {
  $("payloads").replaceChildren(...[...fleet.values()].map(p => {
    const b = document.createElement("button");
    b.textContent = p.name;
    b.className = `${p.name === chosen ? "on" : ""} ${p.link && p.link.up ? "up" : ""}`;
    b.onclick = () => { chosen = p.name; map.center = null; tabs(); panels(); dirty = true; };
    return b;
  }));
}

// The payload's time now, as the station tells it, and how old something of that time is; null while that is not known.
const clockNow = p => p && p.clock ? p.clock.now + performance.now() - p.clock.at : null;
function age(p, t) { const now = clockNow(p); return now == null || t == null ? null : Math.max(0, now - t); }
// A time of the payload in words: UTC where its receiver reported it, else the time of its computer, called so.
function stamp(p, t, from, to) {
  const known = p && p.utc != null, text = new Date(t + (known ? p.utc : 0)).toISOString().replace("T", " ").slice(from, to);
  return [text, known ? "UTC" : "host time"];
}

// Puts a point where its time belongs: what is sent again comes late.
function insert(list, point) {
  let at = list.length;
  while (at > 0 && list[at - 1].t > point.t) at--;
  if (at > 0 && list[at - 1].t === point.t) return;
  list.splice(at, 0, point);
  for (const i of [at, at + 1]) if (i > 0 && i < list.length) list[i].gap = list[i].t - list[i - 1].t > 1000;
  if (list.length > KEEP) list.splice(0, list.length - KEEP);
}

const handlers = {
  hello(m) { map.tiles = m.tiles; position = m.position; },
  est(m, p) {
    let target = p.targets.get(m.target);
    if (!target) p.targets.set(m.target, target = { name: m.target, trail: [], last: null });
    if (m.lat != null) {
      const position = mercator(m.lat, m.lon);
      insert(target.trail, { ...position, t: m.t, v: m.v, w: m.w, sv: m.cov && Math.sqrt(m.cov[4]), sw: m.cov && Math.sqrt(m.cov[5]) });
      m.position = position;
    }
    if (!target.last || m.t >= target.last.t) { target.last = m; if (m.position) target.known = m; }
    // What comes live tells the payload's time until the station says it again.
    if (m.live && (clockNow(p) == null || m.t > clockNow(p))) p.clock = { now: m.t, at: performance.now() };
  },
  own(m, p) {
    m.position = mercator(m.lat, m.lon);
    insert(p.ownTrail, { ...m.position, t: m.t });
    if (!p.own || m.t >= p.own.t) p.own = m;
    if (!p.home || m.t < p.home.t) p.home = m;
  },
  datum(m, p) { p.datum = mercator(m.lat, m.lon); },
  health(m, p) { if (!p.health || m.t >= p.health.t) p.health = m; if (p.name === chosen) panels(); },
  thumb(m, p) { p.thumb = m; p.image.onload = () => { dirty = true; }; p.image.src = `thumbnail/${encodeURIComponent(m.p)}?frame=${m.frame}`; },
  event(m, p) { p.events.push(m); p.events.sort((a, b) => b.t - a.t); p.events.length = Math.min(p.events.length, 60); if (p.name === chosen) events(p); },
  link(m) {
    for (const l of m.payloads) {
      const p = payload(l.name);
      p.link = l; p.utc = l.utc_ms;
      p.clock = l.now == null ? null : { now: l.now, at: performance.now() };
    }
    tabs(); panels();
  },
};

function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${location.pathname.replace(/[^/]*$/, "")}live`);
  socket.onmessage = e => {
    receivedAt = performance.now();
    const m = JSON.parse(e.data), handler = handlers[m.k];
    if (handler) handler(m, m.p == null ? null : payload(m.p));
    dirty = true;
  };
  socket.onopen = () => { receivedAt = performance.now(); };
  socket.onclose = () => { chip($("server"), "station gone", "bad"); setTimeout(connect, 1000); };
}

function chip(element, text, kind) { element.textContent = text; element.className = `chip ${kind}`; }
const number = (x, digits) => x == null || !isFinite(x) ? "–" : x.toFixed(digits);

function numbers(p) {
  const target = p && [...p.targets.values()][0], e = target && target.last, k = target && target.known;
  $("target-name").textContent = target ? target.name : "vehicle";
  const old = e ? age(p, e.t) : null, fresh = old != null && old < STALE_MS;
  const status = e ? (fresh ? e.status : "no news") : "no data";
  chip($("target-status"), status, status === "tracking" ? "good" : status === "lost" || !fresh ? "bad" : "warn");
  const since = k ? age(p, k.t) : null;
  $("target-age").textContent = since == null ? "" : since < 9950 ? `${(since / 1000).toFixed(1)} s` : `${clock(since / 1000)} ago`;
  away("vehicle", p, k && fresh && k.status !== "lost" ? k : null);
  away("helicopter", p, p && p.own && age(p, p.own.t) < OLD_MS ? p.own : null);
  const c = k && k.cov, deg = 180 / Math.PI, s = v => c ? `±${v}` : "";
  $("speed").textContent = number(k && k.v, 2);
  $("heading").textContent = k ? number(((k.h * deg) % 360 + 360) % 360, 0) : "–";
  $("yaw-rate").textContent = number(k && k.w * deg, 1);
  $("sigma").textContent = c ? number(Math.sqrt(Math.max(c[0], c[2])), 2) : "–";
  $("speed-sigma").textContent = c ? s(Math.sqrt(c[4]).toFixed(2)) : "";
  $("heading-sigma").textContent = c ? s(`${(Math.sqrt(c[3]) * deg).toFixed(1)}°`) : "";
  $("yaw-rate-sigma").textContent = c ? s((Math.sqrt(c[5]) * deg).toFixed(1)) : "";
  $("coordinates").textContent = k ? `${k.lat.toFixed(7)}, ${k.lon.toFixed(7)}` : "";
  $("age").textContent = !e ? "" : fresh ? stamp(p, e.t, 0, 21).join(" ") : old == null ? "age not known" : `last known ${(age(p, (k || e).t) / 1000).toFixed(0)} s ago`;
  if (socket && socket.readyState === 1 && performance.now() - receivedAt <= 4000) chip($("server"), fresh ? "live" : "no news", fresh ? "good" : "warn");
  const note = $("map-note"), down = p && p.link && !p.link.up, cut = p && p.link && p.link.silent_ms > 2000;
  note.style.display = e && (!fresh || down) ? "block" : "none";
  note.textContent = down ? "payload not connected" : cut ? `link silent for ${(p.link.silent_ms / 1000).toFixed(0)} s` : "no new estimates";
}

// 3:12, 1:03:12.
function clock(s) {
  const two = x => String(Math.floor(x)).padStart(2, "0");
  return s < 3600 ? `${Math.floor(s / 60)}:${two(s % 60)}` : `${Math.floor(s / 3600)}:${two(s / 60 % 60)}:${two(s % 60)}`;
}

// Distance and bearing of a place from the station; where that is not known, from where the helicopter was first seen.
function away(name, p, to) {
  const from = position ? { lat: position[0], lon: position[1] } : p && p.home, rad = Math.PI / 180;
  if (!from || !to) { $(`to-${name}`).textContent = "–"; $(`from-${name}`).textContent = ""; return; }
  const north = (to.lat - from.lat) * rad * 6371009, east = ((to.lon - from.lon + 540) % 360 - 180) * rad * 6371009 * Math.cos(from.lat * rad);
  const d = Math.hypot(north, east), bearing = (Math.atan2(east, north) / rad + 360) % 360;
  $(`to-${name}`).textContent = `${d < 1000 ? `${d.toFixed(0)} m` : `${(d / 1000).toFixed(2)} km`} ${bearing.toFixed(0).padStart(3, "0")}°`;
  $(`from-${name}`).textContent = position ? "from the station" : "from the start";
}

// What an operator must hear of; null where all is there. What was never there is not lost.
function lost(p) {
  const target = p && [...p.targets.values()][0], e = target && target.last;
  if (p && p.link && !p.link.up && p.own) return `${p.name}: link lost`;
  if (!e || !target.known) return null;
  const old = age(p, e.t);
  if (old == null || old > OLD_MS) return `${target.name}: no news`;
  return e.status === "lost" ? `${target.name} lost` : null;
}

// How the flight does: its record, the card, the power, what else it feeds.
function flight(h, old) {
  const list = [], f = h.figures, w = h.words, dot = kind => old ? "bad" : kind;
  if (w.card != null) {
    const on = w.card === "ok" && f.recording_s != null;
    list.push(["recording", on ? `recording ${clock(f.recording_s)}` : `not recording: card ${w.card}`, dot(on ? "good" : w.card === "off" ? "warn" : "bad")]);
  }
  if (f.card_left_s != null) {
    const m = f.card_left_s / 60;
    list.push(["card", `${m < 120 ? `${m.toFixed(0)} min` : `${(m / 60).toFixed(0)} h`} left (${(f.card_free_mb / 1000).toFixed(1)} GB)`, dot(m < 10 ? "bad" : m < 30 ? "warn" : "good")]);
  } else if (f.card_free_mb != null) list.push(["card", `${(f.card_free_mb / 1000).toFixed(1)} GB left`, dot("good")]);
  if (f.card_dropped) list.push(["dropped by the card", `${f.card_dropped} messages`, "bad"]);
  if (f.supply_v != null) list.push(["supply", `${f.supply_v.toFixed(2)} V`, dot("good")]);
  if (f.temp_c != null) list.push(["temperature", `${f.temp_c.toFixed(0)} °C`, dot("good")]);
  list.push(["MAVLink", w.mavlink || "none is sent", w.mavlink ? dot(/\(/.test(w.mavlink) ? "bad" : "good") : ""]);
  if (w.flight != null) list.push(["flight", w.flight, ""]);
  return list;
}

function rows(table, list) {
  table.replaceChildren(...list.map(([name, value, kind]) => {
    const tr = document.createElement("tr"), a = document.createElement("td"), b = document.createElement("td");
    if (kind) { const dot = document.createElement("span"); dot.className = `dot ${kind}`; a.append(dot); }
    a.append(name); b.textContent = value; tr.append(a, b);
    return tr;
  }));
}

function panels() {
  const p = fleet.get(chosen);
  if (p && p.health) {
    const h = p.health, table = document.createElement("table");
    // Health comes once a second: what is older says nothing of now.
    const since = age(p, h.t), old = since == null || since > OLD_MS, dot = kind => old ? "bad" : kind;
    const quiet = s => s.age_ms < 0 || s.age_ms + (since || 0) > 2000;
    const list = h.sources.map(s => {
      const extra = [s.refused ? `${s.refused} refused` : "", s.dropped ? `${s.dropped} dropped` : ""].filter(Boolean).join(", ");
      return [s.name, `${s.rate_hz.toFixed(1)}/s${extra ? `, ${extra}` : ""}`, quiet(s) ? "bad" : s.dropped ? "warn" : "good"];
    });
    const gps = h.sources.find(s => s.name === "gps"), silent = !gps || quiet(gps);
    const fix = silent ? "none, receiver silent" : `${h.fix === 3 ? "3D" : h.fix === 2 ? "2D" : "none"}, ${h.sats} satellites`;
    list.push(["fix", fix, dot(h.fix && !silent ? "good" : "bad")]);
    if (p.utc == null) list.push(["UTC", "not known; times are the payload's own", "warn"]);
    else if (h.clock_sigma_ms >= 0) list.push(["UTC", `±${h.clock_sigma_ms.toFixed(1)} ms`, dot("good")]);
    for (const m of h.misfits) list.push([m.source, `${m.cause} (${m.figure}): ${m.advice}`, dot("warn")]);
    const apart = ["card", "flight", "mavlink"];
    for (const [name, word] of Object.entries(h.words)) if (!apart.includes(name)) list.push([name, word, dot(/fail|full|none|lost|error|stopped|cannot/i.test(word) ? "bad" : "good")]);
    if (old) list.unshift(["all of this", since == null ? "age not known" : `${(since / 1000).toFixed(0)} s old`, "bad"]);
    rows(table, list); $("sensors").replaceChildren(table);
    const about = document.createElement("table");
    rows(about, flight(h, old)); $("flight").replaceChildren(about);
  }
  if (p && p.link) {
    const l = p.link, table = document.createElement("table"), all = l.received + l.overdue, done = all ? 100 * l.received / all : 100;
    // What is younger than two seconds may still be on its way; what a silent payload has is not known.
    const known = 2 + (l.silent_ms > 2000 || !l.up ? l.silent_ms / 1000 : 0);
    const bar = document.createElement("div"), fill = document.createElement("div");
    bar.className = "bar"; fill.style.width = `${done.toFixed(1)}%`; bar.append(fill);
    rows(table, [
      [l.address, l.up ? (l.silent_ms > 2000 ? `silent ${(l.silent_ms / 1000).toFixed(0)} s` : "connected") : "not connected", l.up ? (l.silent_ms > 2000 ? "warn" : "good") : "bad"],
      ["round trip", `${l.rtt_ms.toFixed(1)} ms`],
      ["live", `${l.live_hz.toFixed(1)} records/s, ${(l.kbps).toFixed(0)} kbit/s`],
      ["kept", `${l.received} records`],
      ["missing", l.overdue ? `${l.overdue} to come, ${done.toFixed(1)} % there` : `nothing up to ${known.toFixed(0)} s ago`, l.overdue ? "warn" : "good"],
      ...(l.gone ? [["lost on board", `${l.gone}`, "warn"]] : []),
      ["on board", l.software],
    ]);
    $("link").replaceChildren(bar, table);
  }
  if (p) events(p);
}

function events(p) {
  $("events").replaceChildren(...p.events.map(e => {
    const li = document.createElement("li"), t = document.createElement("time"), text = document.createElement("span");
    [t.textContent, t.title] = stamp(p, e.t, 11, 19);
    text.textContent = e.text; text.className = e.level >= 4 ? "bad" : e.level === 3 ? "warn" : "";
    li.append(t, text);
    return li;
  }));
}

function plot(canvas, trail, now, value, sigma, unit) {
  const [c, w, h] = surface(canvas), left = 34, bottom = 16, top = 6;
  const points = trail.filter(p => p.t > now - PLOT_S * 1000);
  let low = Infinity, high = -Infinity;
  for (const p of points) { const v = value(p), s = Math.min(sigma(p) || 0, unit * 5); low = Math.min(low, v - s); high = Math.max(high, v + s); }
  if (!points.length) { low = 0; high = unit; }
  const pad = Math.max(unit * 0.25, (high - low) * 0.08); low -= pad; high += pad;
  const x = t => left + (w - left - 4) * (1 - (now - t) / (PLOT_S * 1000)), y = v => top + (h - top - bottom) * (1 - (v - low) / (high - low));
  const raw = (high - low) / 4, p10 = 10 ** Math.floor(Math.log10(raw)), step = [1, 2, 5, 10].map(f => f * p10).find(s => s >= raw);
  c.font = "11px system-ui, sans-serif"; c.lineWidth = 1; c.textAlign = "right";
  for (let v = Math.ceil(low / step) * step; v <= high; v += step) {
    const r = Math.round(y(v)) + 0.5;
    c.strokeStyle = css(Math.abs(v) < step / 2 ? "--grid-strong" : "--grid"); c.beginPath(); c.moveTo(left, r); c.lineTo(w - 4, r); c.stroke();
    c.fillStyle = css("--soft"); c.fillText(String(+v.toFixed(6)), left - 5, r + 4);
  }
  c.textAlign = "center";
  for (let s = 0; s <= PLOT_S; s += 15) c.fillText(s ? `−${s} s` : "now", Math.min(w - 14, x(now - s * 1000)), h - 3);
  c.textAlign = "left"; c.save(); c.beginPath(); c.rect(left, 0, w - left, h - bottom); c.clip();
  const runs = [];
  for (const p of points) { if (p.gap || !runs.length) runs.push([]); runs[runs.length - 1].push(p); }
  for (const run of runs) {
    c.fillStyle = css("--band"); c.beginPath();
    run.forEach((p, i) => c[i ? "lineTo" : "moveTo"](x(p.t), y(value(p) + (sigma(p) || 0))));
    for (const p of [...run].reverse()) c.lineTo(x(p.t), y(value(p) - (sigma(p) || 0)));
    c.fill(); c.strokeStyle = css("--accent"); c.lineWidth = 1.6; c.lineJoin = "round"; c.beginPath();
    run.forEach((p, i) => c[i ? "lineTo" : "moveTo"](x(p.t), y(value(p)))); c.stroke();
  }
  c.restore();
}

function camera(p) {
  const [c, w, h] = surface($("camera")), t = p && p.thumb;
  if (!t || !p.image.complete || !p.image.naturalWidth) {
    c.fillStyle = css("--soft"); c.font = "13px system-ui, sans-serif"; c.textAlign = "center"; c.fillText("no picture yet", w / 2, h / 2); c.textAlign = "left"; return;
  }
  const k = Math.min(w / t.w, h / t.h), u0 = (w - t.w * k) / 2, v0 = (h - t.h * k) / 2;
  c.drawImage(p.image, u0, v0, t.w * k, t.h * k);
  c.lineWidth = 2;
  for (const m of t.markers) {
    const q = (u, v) => [u0 + (u + 0.5) * k, v0 + (v + 0.5) * k];
    c.strokeStyle = css("--accent"); c.beginPath();
    if (m.corners.length === 8) { for (let i = 0; i < 8; i += 2) c[i ? "lineTo" : "moveTo"](...q(m.corners[i], m.corners[i + 1])); c.closePath(); }
    else { const [x, y] = q(m.u, m.v); c.arc(x, y, Math.max(3, m.size * k / 2), 0, TAU); }
    c.stroke();
    const [x, y] = q(m.u, m.v); c.font = "600 12px system-ui, sans-serif"; c.lineWidth = 3; c.strokeStyle = "#000a"; const name = m.id.split(" ").pop(); c.strokeText(name, x + 8, y - 8); c.fillStyle = "#fff"; c.fillText(name, x + 8, y - 8); c.lineWidth = 2;
  }
  $("camera-note").textContent = `frame ${t.frame}, ${t.markers.length} marker${t.markers.length === 1 ? "" : "s"}`;
}

function draw() {
  requestAnimationFrame(draw);
  const now = performance.now();
  if (!dirty && now - draw.last < 250) return;
  dirty = false; draw.last = now;
  const p = fleet.get(chosen), targets = p ? [...p.targets.values()] : [];
  map.draw({
    origin: p && p.datum, ownTrail: p ? p.ownTrail : [],
    own: p && p.own && { position: p.own.position, heading: p.own.heading, above: p.own.above },
    vehicles: targets.map(t => ({
      name: t.name, trail: t.trail, position: t.known && t.known.position, heading: t.known && t.known.h,
      cov: t.known && t.known.cov, fresh: age(p, t.last.t) != null && age(p, t.last.t) < STALE_MS && t.last.status !== "lost",
    })),
  });
  numbers(p); camera(p); alarm.take(lost(p));
  const trail = targets[0] ? targets[0].trail : [], deg = 180 / Math.PI;
  const last = trail.length ? trail[trail.length - 1].t : 0, end = last + Math.min(age(p, last) || 0, 600000);
  plot($("plot-speed"), trail, end, q => q.v, q => q.sv, 0.5);
  plot($("plot-yaw"), trail, end, q => q.w * deg, q => q.sw && q.sw * deg, 5);
}
draw.last = 0;

function theme(dark) { document.documentElement.dataset.theme = dark ? "dark" : "light"; dirty = true; }
let saved = null;
try { saved = localStorage.getItem("theme"); } catch { /* a private window keeps nothing */ }
const system = matchMedia("(prefers-color-scheme: dark)");
theme(saved ? saved === "dark" : system.matches);
system.onchange = e => { if (!saved) theme(e.matches); };
$("theme").onclick = () => {
  const dark = document.documentElement.dataset.theme !== "dark";
  theme(dark); saved = dark ? "dark" : "light";
  try { localStorage.setItem("theme", saved); } catch { /* as above */ }
};
$("zoom-in").onclick = () => map.zoom(1.5);
$("zoom-out").onclick = () => map.zoom(1 / 1.5);
$("follow").onclick = () => { map.follow = true; dirty = true; };
$("whole").onclick = () => {
  const p = fleet.get(chosen), trails = p ? [...p.targets.values()].flatMap(t => t.trail) : [];
  // Without a vehicle the helicopter's own way is what there is to show.
  if (p) map.fit(trails.length ? trails.concat(p.own ? [p.own.position] : []) : p.ownTrail);
};
setInterval(() => {
  $("follow").classList.toggle("on", map.follow);
  if (socket && socket.readyState === 1 && performance.now() - receivedAt > 4000) { chip($("server"), "station silent", "warn"); }
}, 300);
window.addEventListener("resize", () => { dirty = true; });
connect(); draw();
