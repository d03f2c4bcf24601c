// The map: Web Mercator when tiles are given, the same projection under a metric graticule when not.
"use strict";
const TAU = 2 * Math.PI, EARTH = 40075016.686;
const mercator = (lat, lon) => {
  const s = Math.sin(Math.max(-85.05, Math.min(85.05, lat)) * Math.PI / 180);
  return { x: (lon + 180) / 360, y: 0.5 - Math.log((1 + s) / (1 - s)) / (2 * TAU) };
};
const degrees = (x, y) => ({ lat: Math.atan(Math.sinh(Math.PI * (1 - 2 * y))) * 180 / Math.PI, lon: x * 360 - 180 });
const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// A canvas at the screen's own resolution; gives its context and size in CSS pixels.
function surface(canvas) {
  const box = canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
  const w = Math.round(box.width * ratio), h = Math.round(box.height * ratio);
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const c = canvas.getContext("2d");
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.clearRect(0, 0, box.width, box.height);
  return [c, box.width, box.height];
}

class FieldMap {
  constructor(canvas) {
    this.canvas = canvas; this.center = null; this.scale = 12; this.follow = true; this.tiles = null;
    this.cache = new Map(); this.fingers = new Map(); this.moved = () => {};
    canvas.addEventListener("pointerdown", e => { canvas.setPointerCapture(e.pointerId); this.fingers.set(e.pointerId, e); });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, e => this.fingers.delete(e.pointerId));
    canvas.addEventListener("pointermove", e => this.drag(e));
    canvas.addEventListener("wheel", e => { e.preventDefault(); this.zoom(Math.exp(-e.deltaY * 0.0015), e.offsetX, e.offsetY); }, { passive: false });
  }
  // Metres a unit of the projection has at the centre.
  unit() { return EARTH * Math.cos(degrees(this.center.x, this.center.y).lat * Math.PI / 180); }
  pixels() { return this.scale * this.unit(); }
  at(p) { const k = this.pixels(); return [(p.x - this.center.x) * k + this.w / 2, (p.y - this.center.y) * k + this.h / 2]; }
  zoom(factor, u = this.w / 2, v = this.h / 2) {
    if (!this.center) return;
    const k = this.pixels(), before = { x: (u - this.w / 2) / k, y: (v - this.h / 2) / k };
    this.scale = Math.max(0.01, Math.min(200, this.scale * factor));
    const l = this.pixels();
    if (!this.follow) { this.center.x += before.x - (u - this.w / 2) / l; this.center.y += before.y - (v - this.h / 2) / l; }
    this.moved();
  }
  drag(e) {
    const last = this.fingers.get(e.pointerId);
    if (!last || !this.center) return;
    const others = [...this.fingers.entries()].filter(([id]) => id !== e.pointerId);
    if (others.length) {
      const o = others[0][1], d = (a, b) => Math.hypot(a.offsetX - b.offsetX, a.offsetY - b.offsetY);
      this.zoom(d(e, o) / Math.max(1, d(last, o)), (e.offsetX + o.offsetX) / 2, (e.offsetY + o.offsetY) / 2);
    } else {
      const k = this.pixels();
      this.center.x -= (e.offsetX - last.offsetX) / k; this.center.y -= (e.offsetY - last.offsetY) / k;
      this.follow = false;
    }
    this.fingers.set(e.pointerId, e); this.moved();
  }
  fit(points) {
    if (!points.length) return;
    const xs = points.map(p => p.x), ys = points.map(p => p.y);
    const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    this.center = { x: (x0 + x1) / 2, y: (y0 + y1) / 2 }; this.follow = false;
    const k = Math.min(this.w / Math.max(1e-9, x1 - x0), this.h / Math.max(1e-9, y1 - y0)) * 0.8;
    this.scale = Math.min(20, k / this.unit()); this.moved();
  }
  // Draws everything; `origin` is where the graticule counts from.
  draw(scene) {
    const [c, w, h] = surface(this.canvas); this.w = w; this.h = h;
    c.fillStyle = css("--map"); c.fillRect(0, 0, w, h);
    const focus = scene.vehicles.find(v => v.position) || (scene.own && { position: scene.own.position });
    if (focus && (this.follow || !this.center)) this.center = { ...focus.position };
    if (!this.center) { this.empty(c, w, h); return; }
    if (this.tiles) this.drawTiles(c, w, h);
    this.graticule(c, w, h, scene.origin || this.center);
    for (const v of scene.vehicles) this.trail(c, v.trail, css("--accent"), 2.5);
    this.trail(c, scene.ownTrail, css("--own"), 1);
    if (scene.own) this.helicopter(c, scene.own);
    for (const v of scene.vehicles) if (v.position) this.vehicle(c, v);
    this.scaleBar(c, h);
  }
  empty(c, w, h) {
    c.fillStyle = css("--soft"); c.font = "15px system-ui, sans-serif"; c.textAlign = "center";
    c.fillText("waiting for a first position", w / 2, h / 2); c.textAlign = "left";
  }
  drawTiles(c, w, h) {
    const z = Math.max(0, Math.min(this.tiles, Math.round(Math.log2(this.pixels() / 256)))), n = 2 ** z, k = this.pixels() / n;
    const x0 = this.center.x * n - w / 2 / k, y0 = this.center.y * n - h / 2 / k;
    for (let x = Math.floor(x0); x < x0 + w / k; x++) for (let y = Math.floor(y0); y < y0 + h / k; y++) {
      const key = `${z}/${((x % n) + n) % n}/${y}`;
      let tile = this.cache.get(key);
      if (!tile) { tile = new Image(); tile.onload = () => this.moved(); tile.src = `tiles/${key}`; this.cache.set(key, tile); }
      if (this.cache.size > 600) this.cache.delete(this.cache.keys().next().value);
      if (tile.complete && tile.naturalWidth) c.drawImage(tile, (x - x0) * k, (y - y0) * k, k + 0.5, k + 0.5);
    }
  }
  step() { const raw = 90 / this.scale, p = 10 ** Math.floor(Math.log10(raw)); return [1, 2, 5, 10].map(f => f * p).find(s => s >= raw); }
  graticule(c, w, h, origin) {
    const step = this.step(), [u0, v0] = this.at(origin), d = step * this.scale;
    c.lineWidth = 1; c.font = "11px system-ui, sans-serif";
    const line = (i, vertical) => {
      const strong = i % 5 === 0, p = Math.round((vertical ? u0 : v0) + i * d) + 0.5;
      c.strokeStyle = css(strong ? "--grid-strong" : "--grid"); c.beginPath();
      if (vertical) { c.moveTo(p, 0); c.lineTo(p, h); } else { c.moveTo(0, p); c.lineTo(w, p); }
      c.stroke(); c.fillStyle = css("--soft");
      const metres = +(Math.abs(i) * step).toPrecision(6);
      // Not under the buttons.
      if (vertical && p < w - 110) c.fillText(i === 0 ? "0" : `${metres} ${i > 0 ? "E" : "W"}`, p + 4, 13);
      // Not over the scale.
      else if (!vertical && p > 24 && p < h - 40) c.fillText(i === 0 ? "0" : `${metres} ${i > 0 ? "S" : "N"}`, 6, p - 4);
    };
    for (let i = Math.ceil(-u0 / d); i * d + u0 < w; i++) line(i, true);
    for (let i = Math.ceil(-v0 / d); i * d + v0 < h; i++) line(i, false);
  }
  trail(c, points, color, width) {
    if (!points || points.length < 2) return;
    c.strokeStyle = color; c.lineWidth = width; c.lineJoin = "round"; c.globalAlpha = 0.75; c.beginPath();
    let pen = false;
    for (const p of points) {
      const [u, v] = this.at(p);
      if (p.gap || !pen) c.moveTo(u, v); else c.lineTo(u, v);
      pen = true;
    }
    c.stroke(); c.globalAlpha = 1;
  }
  vehicle(c, v) {
    const [x, y] = this.at(v.position), color = css(v.fresh ? "--accent" : "--soft");
    if (v.cov) {
      const [nn, ne, ee] = v.cov, mean = (nn + ee) / 2, half = Math.hypot((nn - ee) / 2, ne);
      const axis = s => Math.sqrt(Math.max(0, s)) * this.scale;
      c.beginPath();
      // Major axis from north clockwise; 2σ outside, 1σ inside.
      const angle = 0.5 * Math.atan2(2 * ne, nn - ee) - Math.PI / 2;
      for (const k of [2, 1]) {
        c.beginPath(); c.ellipse(x, y, Math.max(1, k * axis(mean + half)), Math.max(1, k * axis(mean - half)), angle, 0, TAU);
        c.fillStyle = css("--band"); c.fill(); c.strokeStyle = color; c.lineWidth = 1; c.stroke();
      }
    }
    c.save(); c.translate(x, y); c.rotate(v.heading);
    c.beginPath(); c.moveTo(0, -17); c.lineTo(9, 10); c.lineTo(0, 5); c.lineTo(-9, 10); c.closePath();
    c.fillStyle = color; c.fill(); c.lineWidth = 1.5; c.strokeStyle = css("--card"); c.stroke(); c.restore();
    this.label(c, v.name, x + 14, y - 12, color);
  }
  helicopter(c, own) {
    const [x, y] = this.at(own.position), color = css("--own");
    c.save(); c.translate(x, y); c.rotate(own.heading); c.strokeStyle = color; c.lineWidth = 2;
    c.beginPath(); c.arc(0, 0, 9, 0, TAU); c.moveTo(0, -9); c.lineTo(0, -18); c.moveTo(-6, -6); c.lineTo(6, 6); c.moveTo(6, -6); c.lineTo(-6, 6); c.stroke();
    c.restore(); this.label(c, `helicopter${own.above == null ? "" : ` ${own.above.toFixed(0)} m up`}`, x + 14, y + 20, color);
  }
  label(c, text, x, y, color) {
    c.font = "600 12px system-ui, sans-serif"; c.lineWidth = 3; c.strokeStyle = css("--map");
    c.strokeText(text, x, y); c.fillStyle = color; c.fillText(text, x, y);
  }
  scaleBar(c, h) {
    const step = this.step(), d = step * this.scale, y = h - 16;
    c.strokeStyle = css("--text"); c.lineWidth = 2; c.beginPath();
    c.moveTo(14, y - 5); c.lineTo(14, y); c.lineTo(14 + d, y); c.lineTo(14 + d, y - 5); c.stroke();
    c.fillStyle = css("--text"); c.font = "12px system-ui, sans-serif";
    c.fillText(step >= 1000 ? `${step / 1000} km` : step >= 1 ? `${step} m` : `${+(step * 100).toPrecision(3)} cm`, 20, y - 6);
  }
}
