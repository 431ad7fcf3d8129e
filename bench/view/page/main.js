// The page: what is chosen, and the loop that draws it.

import {View, steer} from "./camera.js";
import {Painter} from "./gl.js";
import {Layer} from "./layers.js";
import {Scenes, element, hex, rgb} from "./panel.js";
import {ask} from "./server.js";
import {Editor} from "./transfer.js";

const REST = 120; // ms without a change, after which full quality is drawn
const GOAL = 60; // ms a frame takes while the camera moves
const LEAST_SHARE = 0.25; // of the size

const byId = (/** @type {string} */ id) => /** @type {any} */ (document.getElementById(id));
const stage = byId("stage"), canvas = byId("canvas");
const view = new View();
const opened = /** @type {Map<number, any>} */ (new Map()); // place -> what the route `open` says
let about, painter, layers, scenes, editor;
let stamp = 0, moved = -1e9, drawn = -1, share = 1, frames = 0, wake = () => {};
let shown = false; // whether the canvas shows all that the layers hold
let bookmark = 0;
let backgroundChosen = false; // by hand

const mode = () => Number(document.querySelector("input[name=mode]:checked").value);
const used = () => mode() === 0 ? [layers[0]] : layers;
const source = (/** @type {Layer} */ layer) => opened.get(layer.source);
const moving = () => performance.now() - moved < REST;

/** Something of the view has changed. */
function changed() {
  if (!source(layers[0])) return;
  ++stamp;
  moved = performance.now();
  delete document.body.dataset.settled;
  refresh();
}

/** A layer, or how layers are shown, has changed. */
function refresh() {
  shown = false;
  wake();
}

/** @param {unknown} error */
function say(error) {
  const text = error instanceof Error ? error.message : String(error ?? "");
  byId("message").hidden = !text;
  byId("message").textContent = text;
}

/** Pixels of a picture: what is chosen, in the shape of the bookmarks, or of the window. */
function size() {
  const chosen = byId("size").value, halves = mode() === 2 ? 2 : 1;
  const camera = source(layers[0]).cameras[0];
  let width = stage.clientWidth, height = stage.clientHeight;
  if (chosen !== "window") {
    const by = Number(chosen) / Math.min(camera.width, camera.height);
    [width, height] = [halves * Math.round(by * camera.width), Math.round(by * camera.height)];
  }
  return [Math.max(1, Math.min(2048, Math.floor(width / halves))), Math.max(1, Math.min(2048, height))];
}

/** @param {Layer} layer @returns {import("./layers.js").Wish} */
function wish(layer) {
  const [width, height] = size(), own = source(layer);
  const background = rgb(byId("background").value);
  const body = {
    source: layer.source, scenes: scenes.of(own), edits: scenes.texts(own), background, ...editor.body(layer.source),
  };
  return {stamp, camera: view.at(width, height), body, least: Number(byId("least").value)};
}

function present() {
  const [width, height] = size(), halves = mode() === 2 ? 2 : 1;
  if (canvas.width !== halves * width || canvas.height !== height) {
    [canvas.width, canvas.height] = [halves * width, height];
  }
  const background = rgb(byId("background").value);
  painter.present(layers[0].picture, layers[1].picture, {mode: mode(), split: Number(byId("split").value), background});
  shown = true;
}

async function loop() {
  for (;;) {
    const waits = () => moving() || !shown || used().some((one) => one.exact !== stamp && !one.busy);
    if (!waits()) await new Promise((done) => { wake = () => done(undefined); if (waits()) done(undefined); });
    await new Promise(requestAnimationFrame);
    const start = performance.now(), now = stamp;
    if (moving()) {
      if (drawn === now && shown) continue;
      drawn = now;
      for (const layer of used()) await layer.quick(wish(layer), share);
      present();
      await painter.finished();
      const took = performance.now() - start;
      if (!frames++) continue; // the first one waits for the Gaussians
      share = Math.min(1, Math.max(LEAST_SHARE, share * Math.min(1.15, Math.max(0.7, Math.sqrt(GOAL / took)))));
      facts(1000 / took);
      continue;
    }
    for (const layer of used()) {
      if (layer.exact === stamp || layer.busy) continue;
      const drawing = layer.full(wish(layer));
      if (layer.task) await drawing;
      else drawing.then(refresh);
    }
    present();
    if (used().every((one) => one.exact === stamp)) {
      await painter.finished();
      document.body.dataset.settled = String(stamp);
      facts();
    }
  }
}

/** Numbers beside the picture. @param {number} [rate] frames a second */
function facts(rate) {
  const rows = [], own = source(layers[0]), names = scenes.of(own);
  if (own.bytes !== null) rows.push(["size", bytes(own.bytes)]);
  if (own.viewer) rows.push(["drawn as in", `${own.viewer} viewers`]);
  if (own.model) {
    const count = own.scenes.filter((one) => names.includes(one.name)).reduce((sum, one) => sum + one.primitives, 0);
    rows.push(["primitives", count.toLocaleString("en")]);
    if (own.seconds !== null) rows.push(["loaded in", `${own.seconds.toFixed(2)} s`]);
  }
  if (layers[0].task) rows.push(["Gaussians in view", layers[0].count.toLocaleString("en")]);
  if (rate) facts.rate = rate;
  if (facts.rate) rows.push(["moving", `${facts.rate.toFixed(0)} FPS at ${Math.round(100 * share)} %`]);
  const scores = mode() ? layers[1].scores : null;
  if (scores) {
    rows.push(["PSNR", `${scores.psnr.toFixed(2)} dB`]);
    if (scores.ssim !== undefined) rows.push(["SSIM", scores.ssim.toFixed(4)], ["ΔE*uv", scores.delta_e_uv.toFixed(2)]);
  }
  const ignored = used().flatMap((one) => scenes.texts(source(one), false));
  if (ignored.length) rows.push(["not edited by it", [...new Set(ignored)].join(" ")]);
  byId("facts").replaceChildren(...rows.flatMap(([name, value]) =>
    [element("dt", {textContent: name}), element("dd", {textContent: value})]));
  say(used().map((one) => one.error).find(Boolean) ?? "");
}
facts.rate = 0;

const bytes = (/** @type {number} */ count) =>
  count < 1 << 20 ? `${(count / 1024).toFixed(1)} KiB` : `${(count / (1 << 20)).toFixed(2)} MiB`;

/** Let a layer show a source, or the truth of the left one. @param {Layer} layer @param {number} place */
async function choose(layer, place, truth = false) {
  try {
    say(`opening ${about.sources[place]} …`);
    if (!opened.has(place)) opened.set(place, await ask("open", {source: place}));
    const first = layer.source === null;
    layer.source = place;
    layer.become(truth ? "truth" : opened.get(place).splats ? "splats" : "picture");
    scenes.show(layers.filter((one) => one.source !== null).map(source));
    if (layer === layers[0]) {
      const known = opened.get(place);
      editor.show(place, known);
      byId("bookmark").replaceChildren(...known.cameras.map((one, i) =>
        element("option", {value: i, textContent: one.name || `view ${i}`})));
      if (!backgroundChosen) byId("background").value = hex(known.background);
      if (first) {
        if (!known.truth && about.sources.length > 1) byId("right").value = "1";
        stand(0);
      } else byId("bookmark").value = bookmark < known.cameras.length ? bookmark : 0;
      const options = [...byId("right").options];
      options[0].disabled = !known.truth;
      options[0].textContent = known.truth ? "its ground truth" : "its ground truth (not at hand)";
      if (byId("right").value === "truth") await choose(layers[1], place, true);
    }
    say("");
    changed();
  } catch (error) {
    say(error);
  }
}

/**
 * Transfer functions of the left source have changed: show one scene.
 * @param {any} known @param {(string | undefined)[]} names of the scene, now and before
 */
function redefined(known, [name, before]) {
  if (!known.scenes.some((/** @type {any} */ one) => one.name === before) && scenes.on.delete(before)) {
    if (!scenes.edits.has(name)) scenes.edits.set(name, scenes.edits.get(before) ?? new Map());
    scenes.on.add(name);
  }
  if (!scenes.on.has(name)) scenes.on = new Set([name]);
  scenes.show(layers.filter((one) => one.source !== null).map(source));
  changed();
}

/** @param {number} place of a bookmark */
function stand(place) {
  const known = source(layers[0]);
  if (!known) return;
  const count = known.cameras.length;
  bookmark = (place + count) % count;
  byId("bookmark").value = bookmark;
  view.stand(known.cameras[bookmark], known.centre);
  changed();
}

/** @param {string} name @param {Blob} blob */
function download(name, blob) {
  const link = element("a", {href: URL.createObjectURL(blob), download: name});
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

function wire() {
  const on = (/** @type {string} */ id, /** @type {string} */ event, /** @type {() => any} */ act) =>
    byId(id).addEventListener(event, () => Promise.resolve(act()).catch(say));
  about.sources.forEach((label, place) => {
    for (const id of ["left", "right"]) byId(id).append(element("option", {value: place, textContent: label}));
  });
  byId("right").prepend(element("option", {value: "truth", textContent: "its ground truth"}));
  byId("right").value = "truth";
  on("left", "change", () => choose(layers[0], Number(byId("left").value)));
  on("right", "change", right);
  on("modes", "change", async () => {
    modes();
    if (mode() && layers[1].source === null) await right();
    changed();
  });
  for (const id of ["split"]) on(id, "input", refresh);
  on("background", "input", () => {
    backgroundChosen = true;
    return layers.some((one) => one.route !== "splats") ? changed() : refresh();
  });
  on("least", "input", () => { byId("leastText").textContent = byId("least").value; changed(); });
  on("size", "change", changed);
  on("bookmark", "change", () => stand(Number(byId("bookmark").value)));
  on("previous", "click", () => stand(bookmark - 1));
  on("next", "click", () => stand(bookmark + 1));
  on("reset", "click", () => stand(bookmark));
  on("unedit", "click", () => {
    scenes.edits.clear();
    scenes.show(layers.filter((one) => one.source !== null).map(source));
    changed();
  });
  on("save", "click", async () => {
    if (!source(layers[0])) return;
    download("edits.toml", new Blob([(await ask("edit", wish(layers[0]).body)).text], {type: "application/toml"}));
  });
  on("shot", "click", () => {
    present(); // what a canvas holds is lost when it was shown
    canvas.toBlob((blob) => download("view.png", blob));
  });
  canvas.addEventListener("keydown", (event) => {
    const act = {n: () => stand(bookmark + 1), p: () => stand(bookmark - 1), r: () => stand(bookmark)}[event.key];
    if (act) act();
  });
  canvas.addEventListener("webglcontextlost", () => say("The graphics card was taken away: load this page again."));
  new ResizeObserver(() => { if (byId("size").value === "window") changed(); }).observe(stage);
  steer(canvas, view, changed);
  const colors = byId("colors").getContext("2d"), image = colors.createImageData(256, 1);
  for (let n = 0; n < 256; ++n) image.data.set([...about.scale.slice(3 * n, 3 * n + 3), 255], 4 * n);
  colors.putImageData(image, 0, 0);
  byId("most").textContent = about.most;
  modes();
}

const right = () => {
  const truth = byId("right").value === "truth";
  return choose(layers[1], truth ? layers[0].source : Number(byId("right").value), truth);
};

/** Show the controls of a mode. */
function modes() {
  byId("against").hidden = mode() === 0;
  byId("slider").hidden = mode() !== 1;
  byId("legend").hidden = mode() !== 3;
}

async function start() {
  about = await ask("about", {});
  if (about.sent) { // one model, without a server
    for (const id of ["models", "modes", "save"]) byId(id).hidden = true;
    byId("title").textContent = about.sources[0];
  }
  painter = new Painter(canvas, about.scale, about.most);
  layers = [new Layer(painter, refresh), new Layer(painter, refresh)];
  scenes = new Scenes(byId("scenes"), changed);
  editor = new Editor(redefined, say, () => ({edits: scenes.texts(source(layers[0]))}), download);
  wire();
  await choose(layers[0], 0);
  if (layers[0].source !== null) await loop();
}

/** For scripts: the values of a picture, the number of frames drawn while moving. */
globalThis.bench = {
  read: (/** @type {number} */ which) => ({
    values: painter.read(layers[which].picture), width: layers[which].picture.width, height: layers[which].picture.height,
  }),
  software: (/** @type {boolean} */ on) => { painter.software = on; changed(); },
  source: (/** @type {number} */ which) => layers[which].source,
  shot: () => { present(); return canvas.toDataURL("image/png"); },
  scenes: () => scenes.of(source(layers[0])),
  tables: () => editor.state.tables, corners: (/** @type {number} */ place) => editor.corners(editor.state.parts[place]),
  frames: () => frames, camera: () => wish(layers[0]).camera, share: () => share,
};
start().catch(say);
