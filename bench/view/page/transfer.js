// The editor of transfer functions: bumps and isosurfaces over the histogram of a volume, under the mouse.
//
// Scenes are tables as a TOML file of scenes has them (datasets/catalogue/own.py). Values are normalised,
// 0 to 1; the numbers beside the curve are in units of the data.

import {element, hex, rgb} from "./panel.js";
import {ask} from "./server.js";

const REACH = 9; // px around a handle
const PAD = 7; // px between the curve and the ends of values
const MOST = 0.99; // opacity of a bump
const LEAST = 1e-6; // of what has to be above 0
const COLORS = ["#57b5e8", "#e69e00", "#cc78a6", "#009e73", "#d65e00", "#0073b3", "#f0e342"]; // Okabe and Ito

/** @typedef {{name: string, range: number[], color: number[], opacity: number}} Bump */
/** @typedef {{name: string, value: number, color: number[], opacity: number}} Surface */
/** @typedef {{name: string, variable: string, bumps?: Bump[], isosurfaces?: Surface[], transfer?: string, preset?: string}} Table */
/** @typedef {{counts: Float32Array, range: number[], picture: HTMLCanvasElement}} Histogram */
const byId = (/** @type {string} */ id) => /** @type {any} */ (document.getElementById(id));
const round = (/** @type {number} */ value) => Math.round(1e6 * value) / 1e6;
const between = (/** @type {number} */ value, /** @type {number} */ low, /** @type {number} */ high) =>
  Math.min(Math.max(value, low), high);
/** Bumps, or isosurfaces: what a scene shows and the mouse takes. @param {Table} table @returns {any[]} */
const parts = (table) => [...table.bumps ?? [], ...table.isosurfaces ?? []];
/** An opacity that such a part may have. @param {any} part @param {number} value */
const opacity = (part, value) => round(part.range ? between(value, 0, MOST) : between(value, LEAST, 1));

/** Tables of one source, and how they came about. */
class Tables {
  /** @param {Table[]} tables */
  constructor(tables) {
    this.original = this.now = JSON.stringify(tables);
    this.past = /** @type {string[]} */ ([]);
    this.future = /** @type {string[]} */ ([]);
    this.scene = this.part = 0; // places of what is selected
    this.histograms = /** @type {Map<string, Histogram>} */ (new Map());
    this.take(this.now);
  }

  /** @param {string} text */
  take(text) {
    this.now = text;
    this.tables = /** @type {Table[]} */ (JSON.parse(text));
    this.scene = between(this.scene, 0, this.tables.length - 1);
    this.part = between(this.part, 0, Math.max(this.parts.length - 1, 0));
  }

  /** Keep what has been changed; `fresh`: what was before can be undone. @param {boolean} fresh */
  keep(fresh) {
    const text = JSON.stringify(this.tables);
    if (text === this.now) return false;
    if (fresh) this.past.push(this.now);
    this.future = [];
    this.now = text;
    return true;
  }

  /** Undo, or redo. @param {boolean} forth */
  step(forth) {
    const [from, to] = forth ? [this.future, this.past] : [this.past, this.future], text = from.pop();
    if (text === undefined) return false;
    to.push(this.now);
    this.take(text);
    return true;
  }

  get table() { return this.tables[this.scene]; }
  get parts() { return parts(this.table); }
}

/** The editor below the picture. */
export class Editor {
  /**
   * @param {(known: any, show: string[]) => void} changed tells which scenes are to be seen
   * @param {(error: unknown) => void} say
   * @param {() => {edits: string[]}} others edits that are saved with the scenes
   * @param {(name: string, blob: Blob) => void} download
   */
  constructor(changed, say, others, download) {
    Object.assign(this, {changed, say, others, download});
    this.canvas = byId("curve");
    this.states = /** @type {Map<number, Tables>} */ (new Map());
    this.state = /** @type {Tables | null} */ (null);
    this.saved = "";
    this.wire();
  }

  /** Edit a source, if its scenes can be. @param {number} place @param {any} known what the route `open` says */
  show(place, known) {
    [this.place, this.known, this.state] = [place, known, null];
    byId("transfer").hidden = !known.tables;
    if (!known.tables) return;
    if (!this.states.has(place)) this.states.set(place, new Tables(known.tables));
    this.state = this.states.get(place);
    byId("variable").replaceChildren(...known.variables.map((/** @type {string} */ one) => option(one, one)));
    byId("saveName").value = byId("saveName").value || "scenes.toml";
    this.refresh();
  }

  /** What a request for pictures says of a source. @param {number} place */
  body(place) {
    const state = this.states.get(place);
    return state && state.now !== state.original ? {tables: state.tables} : {};
  }

  /** Change the tables; whether they are others now. @param {(state: Tables) => void} act @param {boolean} fresh false: amid a drag */
  edit(act, fresh = true) {
    const state = this.state, before = state.table.name;
    act(state);
    const kept = state.keep(fresh);
    if (kept) this.tell(before);
    this.refresh();
    return kept;
  }

  /** Let the page draw. @param {string} [before] name of the scene until now */
  tell(before) {
    const state = this.state;
    const known = new Map(this.known.scenes.map((/** @type {any} */ one) => [one.name, one]));
    this.known.scenes = state.tables.map((one) => {
      const old = known.get(one.name) ?? {light: null, primitives: null};
      return {...old, name: one.name, color: parts(one)[0]?.color ?? old.color};
    });
    this.changed(this.known, [state.table.name, before]);
  }

  /** Show all controls as the tables are. */
  refresh() {
    const state = this.state, {table} = state, all = state.parts, part = all[state.part];
    byId("scene").replaceChildren(...state.tables.map((one, i) => option(i, one.name)));
    byId("scene").value = state.scene;
    byId("sceneName").value = table.name;
    byId("variable").value = table.variable;
    byId("which").replaceChildren(...all.map((one, i) => option(i, one.name)));
    byId("which").value = state.part;
    byId("map").value = table.transfer ?? "";
    byId("preset").value = table.preset ?? "";
    for (const one of document.querySelectorAll("#bump input, #dropBump, #which")) /** @type {any} */ (one).disabled = !part;
    for (const one of document.querySelectorAll("#bump .end")) one.parentElement.hidden = Boolean(part && !part.range);
    byId("value").parentElement.hidden = !part || Boolean(part.range);
    byId("dropScene").disabled = state.tables.length < 2;
    byId("undo").disabled = !state.past.length;
    byId("redo").disabled = !state.future.length;
    if (part) {
      byId("bumpColor").value = hex(part.color);
      byId("opacity").value = part.opacity.toFixed(3);
      if (part.range) {
        document.querySelectorAll("#bump .end").forEach((/** @type {any} */ one, i) => { one.value = this.data(part.range[i]); });
      } else byId("value").value = this.data(part.value);
    }
    this.draw();
  }

  /** A normalised value in units of the data. @param {number} share */
  data(share) {
    const [low, high] = this.histogram()?.range ?? [0, 1];
    return Number((low + share * (high - low)).toPrecision(6));
  }

  /** The normalised value of a number in units of the data. @param {string} text */
  share(text) {
    const [low, high] = this.histogram()?.range ?? [0, 1];
    return (Number(text) - low) / (high - low);
  }

  /** Of the scene's variable; it is asked for if it has not come yet. */
  histogram() {
    const state = this.state, name = state.table.variable;
    if (!state.histograms.has(name)) {
      state.histograms.set(name, null);
      ask("histogram", {source: this.place, variable: name}).then(({counts, density, range}) => {
        state.histograms.set(name, {counts, range, picture: shaded(density)});
        if (state === this.state) this.refresh();
      }).catch(this.say);
    }
    return state.histograms.get(name);
  }

  /** Pixels of the canvas between values 0 and 1, and between opacities 0 and 1. */
  extent() { return [this.canvas.clientWidth - 2 * PAD, this.canvas.clientHeight - 2 * PAD]; }

  /** Places of a part's corners on the canvas, px: four of a bump, the upper end of an isosurface. @param {any} part */
  corners(part) {
    const [width, height] = this.extent(), heights = part.range ? [0, part.opacity, part.opacity, 0] : [part.opacity];
    return (part.range ?? [part.value]).map((/** @type {number} */ value, /** @type {number} */ i) =>
      [PAD + value * width, PAD + (1 - heights[i]) * height]);
  }

  draw() {
    const {canvas, state} = this, {clientWidth: width, clientHeight: height} = canvas;
    if (!width) return;
    const dense = devicePixelRatio || 1, context = canvas.getContext("2d"), known = this.histogram();
    [canvas.width, canvas.height] = [Math.round(width * dense), Math.round(height * dense)];
    context.scale(dense, dense);
    byId("low").textContent = known ? String(this.data(0)) : "";
    byId("high").textContent = known ? String(this.data(1)) : "";
    if (known) {
      const [wide, high] = this.extent();
      context.drawImage(known.picture, PAD, PAD, wide, high);
      const most = Math.log1p(Math.max(...known.counts)), bar = wide / known.counts.length;
      context.fillStyle = "rgba(60, 70, 85, 0.35)";
      known.counts.forEach((count, i) => {
        const tall = Math.log1p(count) / most * high;
        context.fillRect(PAD + i * bar, PAD + high - tall, bar, tall);
      });
    }
    const outline = (/** @type {any} */ part) => {
      const corners = this.corners(part);
      context.beginPath();
      if (!part.range) context.moveTo(corners[0][0], height - PAD);
      for (const [x, y] of corners) context.lineTo(x, y);
    };
    context.setLineDash([4, 3]);
    for (const other of state.tables.filter((one) => one !== state.table && one.variable === state.table.variable)) {
      for (const part of parts(other)) {
        context.strokeStyle = hex(part.color);
        outline(part);
        context.stroke();
      }
    }
    context.setLineDash([]);
    state.parts.forEach((part, place) => {
      outline(part);
      context.fillStyle = `${hex(part.color)}99`;
      context.fill();
      const chosen = place === state.part;
      if (!part.range) {
        [context.strokeStyle, context.lineWidth] = [hex(part.color), 5];
        context.stroke();
      }
      [context.strokeStyle, context.lineWidth] = ["#222", chosen ? 2 : 1];
      context.stroke();
      if (!chosen) return;
      for (const [x, y] of this.corners(part)) {
        context.beginPath();
        context.arc(x, y, 5, 0, 2 * Math.PI);
        context.fillStyle = "#fff";
        context.fill();
        context.stroke();
      }
    });
    if (state.table.transfer) {
      context.fillStyle = "#222";
      context.fillText(`follows the map ${state.table.transfer}`, 2 * PAD, 3 * PAD);
    }
  }

  /** The part and the corner (-1: its body) at a place of the canvas; null: neither. */
  hit(/** @type {number} */ x, /** @type {number} */ y) {
    const {parts: all, part: chosen} = this.state;
    const order = [chosen, ...[...all.keys()].reverse().filter((one) => one !== chosen)].filter((one) => all[one]);
    for (const place of order) {
      const apart = this.corners(all[place]).map((/** @type {number[]} */ [u, v]) => Math.hypot(u - x, v - y));
      const nearest = Math.min(...apart);
      if (nearest > REACH) continue;
      // Of corners at one place the one that the other bounds least: the first at the right end, else the last.
      const corner = all[place].range?.[0] >= 1 ? apart.indexOf(nearest) : apart.lastIndexOf(nearest);
      return {place, corner};
    }
    for (const place of order) {
      const corners = this.corners(all[place]);
      if (!all[place].range) {
        const [[at, above]] = corners;
        if (Math.abs(x - at) <= REACH && y >= above) return {place, corner: -1};
        continue;
      }
      const [[a, floor], [b, top], [c], [d]] = corners;
      const up = x < b ? (x - a) / (b - a) : x > c ? (d - x) / (d - c) : 1;
      if (x >= a && x <= d && y <= floor && y >= floor - up * (floor - top)) return {place, corner: -1};
    }
    return null;
  }

  /** Drags of corners and bodies. */
  wireCanvas() {
    const {canvas} = this;
    let held = /** @type {any} */ (null);
    canvas.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => {
      const found = this.hit(event.offsetX, event.offsetY);
      if (!found) return;
      canvas.setPointerCapture(event.pointerId);
      this.state.part = found.place;
      const {range, value} = this.state.parts[found.place];
      held = {...found, x: event.offsetX, range: [...range ?? [value]], fresh: true};
      this.refresh();
    });
    canvas.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => {
      const [width, height] = this.extent(), value = between((event.offsetX - PAD) / width, 0, 1);
      byId("at").textContent = this.histogram() ? String(this.data(value)) : "";
      if (!held) return canvas.style.setProperty("cursor", this.hit(event.offsetX, event.offsetY) ? "grab" : "default");
      const {corner, range} = held;
      const kept = this.edit((state) => {
        const part = state.parts[held.place], tall = opacity(part, 1 - (event.offsetY - PAD) / height);
        const by = between((event.offsetX - held.x) / width, -range[0], 1 - range.at(-1));
        if (!part.range) {
          part.value = between(round(range[0] + by), LEAST, 1 - LEAST);
          if (corner === 0) part.opacity = tall;
          return;
        }
        if (corner < 0) part.range = range.map((/** @type {number} */ one) => round(one + by));
        else part.range[corner] = round(between(value, part.range[corner - 1] ?? 0, part.range[corner + 1] ?? 1));
        if (corner === 1 || corner === 2) part.opacity = tall;
      }, held.fresh);
      if (kept) held.fresh = false;
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { held = null; });
    new ResizeObserver(() => { if (this.state) this.draw(); }).observe(canvas);
  }

  wire() {
    const on = (/** @type {string} */ id, /** @type {string} */ event, /** @type {() => any} */ act) =>
      byId(id).addEventListener(event, () => Promise.resolve().then(act).catch(this.say));
    on("scene", "change", () => {
      Object.assign(this.state, {scene: Number(byId("scene").value), part: 0});
      this.tell();
      this.refresh();
    });
    on("which", "change", () => { this.state.part = Number(byId("which").value); this.refresh(); });
    on("sceneName", "change", () => this.edit(({table}) => { table.name = byId("sceneName").value.trim(); }));
    on("variable", "change", () => this.edit(({table}) => { table.variable = byId("variable").value; }));
    on("addScene", "click", () => this.edit((state) => {
      const count = state.tables.length, {variable} = state.table, bumps = [bump("bump1", COLORS[count % COLORS.length])];
      state.tables.push({name: free("scene", state.tables), variable, bumps});
      Object.assign(state, {scene: count, part: 0});
    }));
    on("dropScene", "click", () => this.edit((state) => {
      state.tables.splice(state.scene, 1);
      Object.assign(state, {scene: Math.max(state.scene - 1, 0), part: 0});
    }));
    // A scene shows bumps, a map or isosurfaces: one more of one kind takes the place of the others.
    const add = (/** @type {string} */ id, /** @type {"bumps" | "isosurfaces"} */ kind, /** @type {typeof bump | typeof surface} */ make) =>
      on(id, "click", () => this.edit((state) => {
        const {table} = state, own = /** @type {any[]} */ (table[kind] ??= []), stem = id.slice(3).toLowerCase();
        for (const key of ["transfer", "preset", "rescale", "bumps", "isosurfaces"]) if (key !== kind) delete table[key];
        own.push(make(free(stem, own), COLORS[own.length % COLORS.length]));
        state.part = own.length - 1;
      }));
    add("addBump", "bumps", bump);
    add("addSurface", "isosurfaces", surface);
    on("dropBump", "click", () => this.edit((state) => {
      const {bumps = [], isosurfaces = []} = state.table, {part} = state;
      if (part < bumps.length) bumps.splice(part, 1);
      else isosurfaces.splice(part - bumps.length, 1);
      state.part = Math.max(part - 1, 0);
    }));
    let picking = false; // a color: one step of undo, however long it takes to choose it
    on("bumpColor", "input", () => {
      this.edit((state) => { state.parts[state.part].color = rgb(byId("bumpColor").value).map(round); }, !picking);
      picking = true;
    });
    on("bumpColor", "change", () => { picking = false; });
    on("opacity", "change", () => this.edit((state) => {
      const part = state.parts[state.part];
      part.opacity = opacity(part, Number(byId("opacity").value));
    }));
    on("value", "change", () => this.edit((state) => {
      state.parts[state.part].value = between(round(this.share(byId("value").value)), LEAST, 1 - LEAST);
    }));
    document.querySelectorAll("#bump .end").forEach((/** @type {any} */ input, i) => {
      input.addEventListener("change", () => this.edit((state) => {
        const {range} = state.parts[state.part];
        range[i] = round(between(this.share(input.value), range[i - 1] ?? 0, range[i + 1] ?? 1));
      }));
    });
    for (const id of ["map", "preset"]) {
      on(id, "change", () => this.edit(({table}) => {
        const [file, preset] = [byId("map").value.trim(), byId("preset").value.trim()];
        if (!file) return;
        delete table.bumps, delete table["isosurfaces"];
        Object.assign(table, {transfer: file, preset});
      }));
    }
    on("propose", "click", async () => {
      const {state} = this, {variable} = state.table;
      const {tables} = await ask("propose", {source: this.place, variable});
      if (state === this.state) this.edit(() => {
        // In place of the scenes of this variable: they are other answers to the same question.
        state.tables = state.tables.filter((one) => one.variable !== variable);
        const first = state.tables.length;
        for (const one of tables) {
          const taken = state.tables.some(({name}) => name === one.name);
          state.tables.push({...one, name: taken ? free(`${variable}_${one.name}_`, state.tables) : one.name});
        }
        Object.assign(state, {scene: first, part: 0});
      });
    });
    const step = (/** @type {boolean} */ forth) => {
      const before = this.state.table.name;
      if (this.state.step(forth)) this.tell(before);
      this.refresh();
    };
    for (const id of ["undo", "redo"]) on(id, "click", () => step(id === "redo"));
    addEventListener("keydown", (event) => {
      if (!this.state || !(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "z") return;
      event.preventDefault();
      step(event.shiftKey);
    });
    const ready = (/** @type {boolean} */ over, text = "") => {
      this.over = over;
      byId("saveScenes").textContent = over ? "replace it" : "save";
      byId("command").textContent = text;
    };
    on("saveName", "input", () => ready(false));
    on("saveScenes", "click", async () => {
      const name = byId("saveName").value.trim(), {over} = this;
      ready(false);
      const body = {source: this.place, tables: this.state.tables, ...this.others(), name, over};
      const {exists, text, command} = await ask("save", body);
      ready(Boolean(exists), exists ? `${name} exists` : command);
      if (exists) return;
      this.saved = text;
      byId("download").hidden = false;
      this.say("");
    });
    on("download", "click", () =>
      this.download(byId("saveName").value.trim(), new Blob([this.saved], {type: "application/toml"})));
    this.wireCanvas();
  }
}

const option = (/** @type {any} */ value, /** @type {string} */ textContent) => element("option", {value, textContent});

/** @param {string} name @param {string} color @returns {Bump} in the middle */
const bump = (name, color) => ({name, range: [0.4, 0.475, 0.525, 0.6], color: rgb(color).map(round), opacity: 0.5});

/** @param {string} name @param {string} color @returns {Surface} in the middle */
const surface = (name, color) => ({name, value: 0.5, color: rgb(color).map(round), opacity: 0.8});

/** A name that none has yet. @param {string} stem @param {{name: string}[]} taken */
function free(stem, taken) {
  let n = taken.length + 1;
  while (taken.some(({name}) => name === stem + n)) ++n;
  return stem + n;
}

/** A picture of counts by gradient and value, the steepest on top. @param {Float32Array} density */
function shaded(density) {
  const side = Math.round(Math.sqrt(density.length)), most = Math.log1p(Math.max(...density));
  const picture = /** @type {HTMLCanvasElement} */ (element("canvas", {width: side, height: side}));
  const context = picture.getContext("2d"), image = context.createImageData(side, side);
  density.forEach((count, n) => {
    const light = 255 * (1 - 0.55 * Math.log1p(count) / most), y = side - 1 - Math.floor(n / side);
    image.data.set([light, 0.5 * (light + 255), 255, 255], 4 * (y * side + n % side));
  });
  context.putImageData(image, 0, 0);
  return picture;
}
