// The controls of scenes: which are shown, and their edits, as `bench render --edit` takes them.

/** Part of an edit -> kind, label, least, greatest, usual value of its sliders. */
const SLIDERS = {
  opacity: [["opacity", "opacity ×", 0, 4, 1]],
  shading: [
    ["ambient", "ambient ×", 0, 3, 1], ["diffuse", "diffuse ×", 0, 3, 1],
    ["specular", "specular ×", 0, 5, 1], ["shininess", "shininess ×", 0.05, 5, 1],
  ],
  transfer: [["shift", "shift, widths", -2, 2, 0], ["width", "width ×", 0.25, 4, 1]],
};

/** @param {string} tag @param {object} values of properties @param {...(Node | string)} children */
export function element(tag, values = {}, ...children) {
  const made = Object.assign(document.createElement(tag), values);
  made.append(...children);
  return made;
}

/** @param {number[]} color in [0, 1] */
export const hex = (color) =>
  "#" + color.map((one) => Math.round(255 * Math.min(Math.max(one, 0), 1)).toString(16).padStart(2, "0")).join("");

/** @param {string} text #rrggbb */
export const rgb = (text) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16) / 255);

/** Scenes that are on, and their edits; the same for both pictures. */
export class Scenes {
  /** @param {HTMLElement} root @param {() => void} changed */
  constructor(root, changed) {
    this.root = root;
    this.changed = changed;
    this.on = new Set();
    this.edits = /** @type {Map<string, Map<string, string>>} */ (new Map()); // scene -> kind -> value
  }

  /** Controls for the scenes of what is shown. @param {any[]} sources as the route `open` describes them */
  show(sources) {
    for (const source of sources) {
      if (!source.scenes.some((/** @type {any} */ one) => this.on.has(one.name))) {
        for (const name of source.shown) this.on.add(name);
      }
    }
    const scenes = new Map(), parts = new Map();
    for (const source of sources) {
      for (const scene of source.scenes) {
        if (!scenes.get(scene.name)?.color) scenes.set(scene.name, scene);
        parts.set(scene.name, new Set([...(parts.get(scene.name) ?? []), ...source.edits]));
      }
    }
    const several = scenes.size > 1;
    this.root.replaceChildren(element("h2", {textContent: "scenes"}));
    for (const [name, scene] of scenes) this.root.append(this.controls(scene, parts.get(name), several));
  }

  /** @param {any} scene @param {Set<string>} parts that can be edited @param {boolean} several */
  controls(scene, parts, several) {
    const {name} = scene, box = element("details", {open: this.on.has(name)});
    const shown = element("input", {type: "checkbox", checked: this.on.has(name)});
    shown.addEventListener("change", () => {
      shown.checked ? this.on.add(name) : this.on.delete(name);
      this.changed();
    });
    box.append(element("summary", {}, ...(several ? [shown, " "] : []), name));
    if (parts.has("palette")) {
      const value = this.edits.get(name)?.get("palette") ?? hex(scene.color ?? [0.5, 0.5, 0.5]);
      const color = element("input", {type: "color", value});
      color.addEventListener("input", () => this.set(name, "palette", color.value));
      box.append(element("label", {}, "color", color));
    }
    for (const part of Object.keys(SLIDERS).filter((one) => parts.has(one))) {
      for (const [kind, label, min, max, usual] of SLIDERS[part]) {
        const value = Number(this.edits.get(name)?.get(kind) ?? usual);
        const slider = element("input", {type: "range", min, max, step: 0.01, value, name: kind});
        const text = element("output", {textContent: value.toFixed(2)});
        slider.addEventListener("input", () => {
          text.textContent = Number(slider.value).toFixed(2);
          this.set(name, kind, Number(slider.value) === usual ? null : slider.value);
        });
        box.append(element("label", {}, label, text, slider));
      }
    }
    if (parts.has("light")) box.append(...this.light(scene));
    return box;
  }

  /** A headlight, or a direction by two angles. @param {any} scene */
  light({name, light}) {
    const own = this.edits.get(name)?.get("light");
    const at = own && own !== "headlight" ? own.split(",").map(Number) : light ?? [1, 0, 0.5];
    const around = Math.round(Math.atan2(at[1], at[0]) * 180 / Math.PI);
    const above = Math.round(Math.atan2(at[2], Math.hypot(at[0], at[1])) * 180 / Math.PI);
    const head = element("input", {type: "checkbox", checked: own ? own === "headlight" : light === null, name: "headlight"});
    const angles = [
      element("input", {type: "range", min: -180, max: 180, value: around, name: "around"}),
      element("input", {type: "range", min: -90, max: 90, value: above, name: "above"}),
    ];
    const changed = () => {
      const [a, b] = angles.map((one) => Number(one.value) * Math.PI / 180);
      const way = [Math.cos(b) * Math.cos(a), Math.cos(b) * Math.sin(a), Math.sin(b)];
      this.set(name, "light", head.checked ? "headlight" : way.map((one) => one.toFixed(4)).join(","));
    };
    for (const one of angles) one.addEventListener("input", () => { head.checked = false; changed(); });
    head.addEventListener("change", changed);
    return [
      element("label", {}, "light at the camera", head),
      element("label", {}, "light around, °", angles[0]), element("label", {}, "light above, °", angles[1]),
    ];
  }

  /** @param {string} scene @param {string} kind @param {string | null} value null: as it was trained */
  set(scene, kind, value) {
    if (!this.edits.has(scene)) this.edits.set(scene, new Map());
    value === null ? this.edits.get(scene).delete(kind) : this.edits.get(scene).set(kind, value);
    this.changed();
  }

  /** Scenes that are on, of a source. @param {any} source */
  of(source) {
    return source.scenes.map((/** @type {any} */ one) => one.name).filter((/** @type {string} */ name) => this.on.has(name));
  }

  /** Edits of a source that it honours, or does not, in the words of the command line. @param {any} source @param {boolean} honoured */
  texts(source, honoured = true) {
    const parts = new Set(source.edits);
    const part = (/** @type {string} */ kind) =>
      Object.keys(SLIDERS).find((one) => SLIDERS[one].some(([own]) => own === kind)) ?? kind;
    return this.of(source).flatMap((/** @type {string} */ scene) =>
      [...(this.edits.get(scene) ?? [])].filter(([kind]) => parts.has(part(kind)) === honoured)
        .map(([kind, value]) => `${scene}.${kind}=${value}`));
  }
}
