"use strict";
// Flips between images of a scene, and keeps zoom, position and exposure of all panels in step.
const DATA = JSON.parse(document.getElementById("data").textContent);
const MOST_ZOOM = 64, STEP = 1.25;
const at = (id) => document.getElementById(id);
const state = { scene: 0, shot: 0, before: 0, beside: "flip", all: false, zoom: 1, x: 0.5, y: 0.5, stops: 0 };
let panels = []; // of the current scene: {view, light, sheet, images, caption, value, none, what()}
const scene = () => DATA.scenes[state.scene];
const shown = () => scene().shots.filter((shot) => shot.image);
const current = () => scene().shots[state.shot];

function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

function number(value) {
  if (value === null || value === undefined) return "–";
  if (typeof value !== "number") return String(value);
  const size = Math.abs(value);
  if (value === 0) return "0";
  if (size < 1e-4 || size >= 1e6) return value.toExponential(1);
  return size >= 100 ? String(Math.round(value)) : String(Number(value.toPrecision(3)));
}

function addPanel(images, what, sheetSize) {
  const sheet = make("div", { class: "sheet" }), caption = make("b"), value = make("span");
  const light = make("div", { class: "light" }, sheet), none = make("div", { class: "none" });
  const view = make("div", { class: "view", tabindex: "0", role: "img" }, light, none);
  sheet.style.width = sheetSize[0] + "px";
  sheet.style.height = sheetSize[1] + "px";
  const made = {};
  for (const [name, source] of Object.entries(images)) {
    if (!source) continue;
    made[name] = make("img", { src: source, alt: "", "data-name": name, draggable: "false" });
    sheet.append(made[name]);
  }
  const panel = { view, light, sheet, images: made, caption, value, none, what };
  at("panels").append(make("figure", { class: "panel" }, make("figcaption", {}, caption, value), view));
  listen(view);
  panels.push(panel);
}

// What the second panel has of a shot; a map that a reference does not have is said in words.
function heat(shot, kind) {
  const map = DATA.maps[kind];
  return { name: kind, label: map.title + ", " + shot.label, value: "", map, none: shot[kind] ? "" : "this is what the others are compared with" };
}

function build() {
  at("panels").replaceChildren();
  panels = [];
  const { size, shots } = scene(), reference = shots[0];
  if (state.all) {
    for (const shot of shown()) {
      const what = () => {
        const image = { name: "image", label: shot.label, value: summary(shot) };
        return shot[state.beside] ? { ...image, name: state.beside, map: DATA.maps[state.beside] } : image;
      };
      addPanel({ image: shot.image, flip: shot.flip, difference: shot.difference }, what, size);
    }
  } else {
    const images = Object.fromEntries(shots.map((shot, k) => ["image" + k, shot.image]));
    addPanel(images, () => ({ name: "image" + state.shot, label: current().label, value: summary(current()) }), size);
    if (state.beside !== "none") {
      const others = { image: reference.image };
      shots.forEach((shot, k) => { others[state.beside + k] = shot[state.beside]; });
      addPanel(others, () => {
        if (state.beside === "reference") return { name: "image", label: reference.label, value: "" };
        return { ...heat(current(), state.beside), name: state.beside + state.shot };
      }, size);
    }
  }
  arrange();
}

function summary(shot) {
  const first = DATA.columns[0];
  return first && typeof shot.numbers[first] === "number" ? first + " " + number(shot.numbers[first]) : "";
}

function arrange() {
  const box = at("panels"), [width, height] = scene().size, n = panels.length;
  let best = [0, 1];
  for (let columns = 1; columns <= n; columns++) {
    const rows = Math.ceil(n / columns);
    const fit = Math.min(box.clientWidth / columns / width, (box.clientHeight / rows - 24) / height);
    if (fit > best[0]) best = [fit, columns];
  }
  box.style.setProperty("--columns", best[1]);
  render();
}

function base() {
  const view = panels[0].view, [width, height] = scene().size;
  return Math.min(view.clientWidth / width, view.clientHeight / height) || 1;
}

function render() {
  write(); // first, since text decides how much room is left for images
  const view = panels[0].view, [width, height] = scene().size, scale = base() * state.zoom;
  const half = [view.clientWidth / 2 / (width * scale), view.clientHeight / 2 / (height * scale)];
  const inside = (x, h) => (h >= 0.5 ? 0.5 : Math.min(Math.max(x, h), 1 - h)); // no more background than must be
  [state.x, state.y] = [inside(state.x, half[0]), inside(state.y, half[1])];
  const left = view.clientWidth / 2 - state.x * width * scale, top = view.clientHeight / 2 - state.y * height * scale;
  const transform = `translate(${left.toFixed(2)}px, ${top.toFixed(2)}px) scale(${scale.toFixed(5)})`;
  for (const panel of panels) {
    panel.sheet.style.transform = transform;
    panel.sheet.classList.toggle("sharp", scale * devicePixelRatio >= 1);
  }
  at("scale").textContent = "×" + (scale >= 10 ? scale.toFixed(0) : scale.toPrecision(2));
}

function write() {
  for (const panel of panels) {
    const what = panel.what();
    for (const [name, image] of Object.entries(panel.images)) image.classList.toggle("on", name === what.name);
    panel.light.style.filter = what.map || !state.stops ? "none" : "url(#light)";
    panel.caption.textContent = what.label;
    panel.value.textContent = what.value;
    panel.view.setAttribute("aria-label", what.label);
    panel.none.textContent = what.none || "";
  }
  describe(DATA.maps[state.beside]);
  at("stops").textContent = (state.stops > 0 ? "+" : "") + state.stops;
  at("exposure").value = state.stops;
  for (const f of document.querySelectorAll("#light feComponentTransfer *")) f.setAttribute("slope", 2 ** state.stops);
  for (const b of document.querySelectorAll("[data-beside]")) b.setAttribute("aria-pressed", b.dataset.beside === state.beside);
  at("all").setAttribute("aria-pressed", state.all);
  [...at("values").tBodies[0].rows].forEach((row, k) => {
    row.classList.toggle("on", k === state.shot);
    row.querySelector("button").setAttribute("aria-pressed", k === state.shot);
  });
}

function describe(map) {
  const [low, colors, high] = at("legend").children;
  at("legend").hidden = !map;
  if (!map) return;
  [low.textContent, high.textContent] = map.ends;
  colors.style.background = `linear-gradient(to right, ${map.colors.join(",")})`;
}

function table() {
  const columns = DATA.columns, shots = scene().shots;
  const head = make("tr", {}, make("th", { scope: "col" }, "image"), ...columns.map((c) => make("th", { scope: "col" }, c)));
  at("values").tHead.replaceChildren(head);
  const best = columns.map((c) => Math.min(...shots.map((s) => (DATA.lower.includes(c) && typeof s.numbers[c] === "number" ? s.numbers[c] : Infinity))));
  let key = 0;
  at("values").tBodies[0].replaceChildren(...shots.map((shot, k) => {
    const button = make("button", { type: "button" }, make("kbd", {}, shot.image ? String(++key) : "·"), shot.label);
    if (shot.image) button.addEventListener("click", () => choose(k));
    else button.disabled = true;
    const cells = columns.map((c, j) => make("td", shot.numbers[c] === best[j] ? { class: "best" } : {}, shot.image ? number(shot.numbers[c]) : ""));
    if (!shot.image && cells.length) cells.splice(0, cells.length, make("td", { colspan: String(columns.length) }, shot.why));
    return make("tr", shot.image ? {} : { class: "absent" }, make("td", {}, button), ...cells);
  }));
}

function choose(k) {
  if (!scene().shots[k] || !scene().shots[k].image) return;
  if (k !== state.shot) state.before = state.shot;
  state.shot = k;
  if (state.all) { state.all = false; build(); } else render();
  announce();
}

function step(by) {
  const available = shown(), k = available.indexOf(current());
  choose(scene().shots.indexOf(available[(k + by + available.length) % available.length]));
}

function announce() {
  const values = DATA.columns.filter((c) => current().numbers[c] !== undefined).map((c) => c + " " + number(current().numbers[c]));
  at("status").textContent = [scene().name, current().label, ...values].join(" · ");
  history.replaceState(null, "", "#" + [scene().name, current().label].map(encodeURIComponent).join("/"));
}

function enter(k, label) {
  const n = DATA.scenes.length, wanted = label === undefined ? current().label : label, size = String(scene().size);
  state.scene = ((k % n) + n) % n;
  const found = scene().shots.findIndex((shot) => shot.label === wanted && shot.image);
  state.shot = found < 0 ? scene().shots.findIndex((shot) => shot.image) : found;
  state.before = scene().shots.findIndex((shot) => shot.image);
  if (String(scene().size) !== size) Object.assign(state, { zoom: 1, x: 0.5, y: 0.5 });
  [...at("scenes").children].forEach((tab, j) => {
    tab.setAttribute("aria-selected", j === state.scene);
    tab.tabIndex = j === state.scene ? 0 : -1;
  });
  table();
  build();
  announce();
}

function zoomBy(factor, px, py) {
  const view = panels[0].view, [width, height] = scene().size, before = base() * state.zoom;
  state.zoom = Math.min(Math.max(state.zoom * factor, 1), Math.max(MOST_ZOOM / base(), 1));
  const after = base() * state.zoom, dx = (px ?? view.clientWidth / 2) - view.clientWidth / 2, dy = (py ?? view.clientHeight / 2) - view.clientHeight / 2;
  move((dx * (1 / before - 1 / after)) / width, (dy * (1 / before - 1 / after)) / height);
}

function move(dx, dy) {
  state.x += dx;
  state.y += dy;
  render();
}

function expose(stops) {
  state.stops = Math.min(Math.max(stops, -4), 6);
  render();
}

function beside(kind) {
  state.beside = state.beside === kind ? "none" : kind;
  build();
}

function listen(view) {
  const held = new Map();
  const middle = () => [...held.values()].reduce((sum, p) => [sum[0] + p[0] / held.size, sum[1] + p[1] / held.size], [0, 0]);
  const spread = () => (held.size < 2 ? 1 : Math.hypot(...[0, 1].map((k) => [...held.values()][0][k] - [...held.values()][1][k])) || 1);
  const point = (event) => { const box = view.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  view.addEventListener("wheel", (event) => { event.preventDefault(); zoomBy(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...point(event)); }, { passive: false });
  view.addEventListener("pointerdown", (event) => { held.set(event.pointerId, point(event)); view.setPointerCapture(event.pointerId); view.classList.add("held"); });
  view.addEventListener("pointermove", (event) => {
    if (!held.has(event.pointerId)) return;
    const [from, wide] = [middle(), spread()], scale = base() * state.zoom, [width, height] = scene().size;
    held.set(event.pointerId, point(event));
    const to = middle();
    move((from[0] - to[0]) / scale / width, (from[1] - to[1]) / scale / height);
    if (held.size > 1) zoomBy(spread() / wide, ...to);
  });
  for (const end of ["pointerup", "pointercancel"]) view.addEventListener(end, (event) => { held.delete(event.pointerId); if (!held.size) view.classList.remove("held"); });
  view.addEventListener("dblclick", fit);
}

function fit() {
  Object.assign(state, { zoom: 1, x: 0.5, y: 0.5 });
  render();
}

function key(event) {
  if (event.ctrlKey || event.altKey || event.metaKey || event.target === at("exposure")) return;
  if (event.key === " " && ["BUTTON", "SUMMARY"].includes(event.target.tagName)) return;
  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const plain = {
    r: () => beside("reference"), f: () => beside("flip"), d: () => beside("difference"), a: () => { state.all = !state.all; build(); },
    "+": () => zoomBy(STEP), "=": () => zoomBy(STEP), "-": () => zoomBy(1 / STEP), 0: fit,
    " ": () => choose(state.before),
    "[": () => expose(state.stops - 0.5), "]": () => expose(state.stops + 0.5),
  };
  if (event.key in arrows) {
    const [x, y] = arrows[event.key], far = 0.2 / state.zoom;
    if (event.shiftKey) move(x * far, y * far);
    else if (event.target.getAttribute("role") === "tab" || y) { enter(state.scene + x + y); if (event.target.getAttribute("role") === "tab") at("scenes").children[state.scene].focus(); }
    else step(x);
  } else if (/^[1-9]$/.test(event.key)) choose(scene().shots.indexOf(shown()[event.key - 1]));
  else if (plain[event.key.toLowerCase()]) plain[event.key.toLowerCase()]();
  else return;
  event.preventDefault();
}

function start() {
  DATA.scenes.forEach((s, k) => {
    const tab = make("button", { type: "button", role: "tab" }, s.name);
    tab.addEventListener("click", () => enter(k));
    at("scenes").append(tab);
  });
  at("scenes").hidden = DATA.scenes.length < 2;
  for (const button of document.querySelectorAll("[data-beside]")) button.addEventListener("click", () => beside(button.dataset.beside));
  at("all").addEventListener("click", () => { state.all = !state.all; build(); });
  at("in").addEventListener("click", () => zoomBy(STEP));
  at("out").addEventListener("click", () => zoomBy(1 / STEP));
  at("fit").addEventListener("click", fit);
  at("exposure").addEventListener("input", (event) => expose(Number(event.target.value)));
  document.addEventListener("keydown", key);
  new ResizeObserver(() => arrange()).observe(at("panels"));
  const [name, label] = location.hash.slice(1).split("/").map(decodeURIComponent);
  const first = Math.max(DATA.scenes.findIndex((s) => s.name === name), 0), shots = DATA.scenes[first].shots;
  enter(first, label ?? (shots.find((shot) => shot.flip) ?? shots[0]).label);
}

start();
