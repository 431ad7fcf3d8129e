// The answers of a page that was sent (bench/view/sent.py): all that it shows lies in the file itself.
//
// The window reads the file; a worker, which splats, gets the texts of all scenes as its first message.

/** @typedef {{means: Float32Array, quats: Float32Array, scales: Float32Array, opacities: Float32Array,
 *   harmonics: Float32Array, response: Float32Array | null, terms: number}} Part */

const page = globalThis.document;
const text = (/** @type {string} */ id) => page.getElementById(id).textContent;
const parts = /** @type {Map<string, Promise<Part>>} */ (new Map());
let held = page ? {facts: JSON.parse(text("facts-held"))} : null;
let code = "";

if (!page) {
  globalThis.addEventListener("message", (event) => {
    if (!event.data.facts) return;
    event.stopImmediatePropagation();
    held = event.data;
  });
}

/** What runs splats.js: this same script. */
export function worker() {
  code ||= URL.createObjectURL(new Blob([text("code")], {type: "text/javascript"}));
  const made = new Worker(code);
  made.postMessage({...held, texts: held.facts.parts.map((_, n) => text(`data-${n}`))});
  return made;
}

/**
 * As server.js asks the server.
 * @param {string} route @param {any} body
 */
export async function ask(route, body) {
  if (route !== "splats") return held.facts[route];
  const all = held.facts.parts, shown = [];
  let count = 0;
  for (const [place, one] of all.entries()) {
    if (!body.scenes.includes(one.name)) continue;
    if (!parts.has(one.name)) parts.set(one.name, unpacked(one, held.texts[place]));
    shown.push({one, part: await parts.get(one.name), edit: edit(one.name, body.edits), first: count});
    count += one.count;
  }
  if (!shown.length) throw new Error("no scene is switched on. Switch one on");
  const key = JSON.stringify(shown.map(({one, edit}) => [one.name, edit.opacity]));
  const answer = {...held.facts.filter, key, colors: new Float32Array(3 * count)};
  const eye = [3, 7, 11].map((i) => body.camera.matrix[i]);
  for (const {one, part, edit, first} of shown) {
    const shift = edit.palette ? edit.palette.map((value, c) => value - one.palette[c]) : null;
    shade(part, eye, shift, answer.colors.subarray(3 * first, 3 * (first + one.count)));
  }
  if (body.has === key) return answer;
  for (const [name, width] of Object.entries({means: 3, quats: 4, scales: 3, opacities: 1})) {
    answer[name] = new Float32Array(width * count);
    for (const {part, first} of shown) answer[name].set(part[name], width * first);
  }
  for (const {one, edit, first} of shown) { // optical depths are multiplied
    for (let n = first; n < first + one.count && edit.opacity !== 1; ++n) {
      answer.opacities[n] = 1 - (1 - answer.opacities[n]) ** edit.opacity;
    }
  }
  return answer;
}

/** The edit of a scene, from the words of the command line. @param {string} name @param {string[]} edits */
function edit(name, edits) {
  const found = {opacity: 1, palette: null};
  for (const one of edits) {
    const words = one.startsWith(`${name}.`) ? /^(opacity|palette)=(.+)$/.exec(one.slice(name.length + 1)) : null;
    if (words?.[1] === "opacity") found.opacity = Number(words[2]);
    else if (words) found.palette = [1, 3, 5].map((i) => parseInt(words[2].slice(i, i + 2), 16) / 255);
  }
  return found;
}

/**
 * Numbers of a scene from its text: base64 of deflated planes, the upper bytes of all columns, then the lower.
 * @param {{count: number, columns: [string, number][], ranges: number[]}} one ranges: least value and step, by column
 * @param {string} packed
 * @returns {Promise<Part>}
 */
async function unpacked({count, columns, ranges}, packed) {
  const letters = atob(packed), bytes = new Uint8Array(letters.length);
  for (let n = 0; n < bytes.length; ++n) bytes[n] = letters.charCodeAt(n);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer()), half = planes.length / 2;
  const part = /** @type {any} */ ({response: null});
  let column = 0;
  for (const [name, width] of columns) {
    const values = part[name] = new Float32Array(width * count);
    for (let c = 0; c < width; ++c, ++column) {
      const least = ranges[2 * column], step = ranges[2 * column + 1];
      for (let n = 0, at = column * count; n < count; ++n, ++at) {
        values[width * n + c] = least + step * (256 * planes[at] + planes[half + at]);
      }
    }
  }
  part.terms = part.harmonics.length / (3 * count);
  part.scales = part.scales.map(Math.exp);
  part.opacities = part.opacities.map((/** @type {number} */ one) => 1 / (1 + Math.exp(-one)));
  return part;
}

const basis = new Float64Array(16);

/**
 * Colors seen from a place: spherical harmonics as in econgs/splat/sh.py, and what a change of the palette adds.
 * @param {Part} part @param {number[]} eye @param {number[] | null} shift of the palette color
 * @param {Float32Array} colors that are filled
 */
function shade({means, harmonics, response, terms}, [px, py, pz], shift, colors) {
  for (let n = 0, h = 0; 3 * n < colors.length; ++n) {
    let x = means[3 * n] - px, y = means[3 * n + 1] - py, z = means[3 * n + 2] - pz;
    const inverse = 1 / (Math.hypot(x, y, z) || 1);
    x *= inverse; y *= inverse; z *= inverse;
    const xx = x * x, yy = y * y, zz = z * z;
    basis[0] = 0.28209479177387814;
    basis[1] = -0.4886025119029199 * y;
    basis[2] = 0.4886025119029199 * z;
    basis[3] = -0.4886025119029199 * x;
    basis[4] = 1.0925484305920792 * x * y;
    basis[5] = -1.0925484305920792 * y * z;
    basis[6] = 0.31539156525252005 * (2 * zz - xx - yy);
    basis[7] = -1.0925484305920792 * x * z;
    basis[8] = 0.5462742152960396 * (xx - yy);
    basis[9] = -0.5900435899266435 * y * (3 * xx - yy);
    basis[10] = 2.890611442640554 * x * y * z;
    basis[11] = -0.4570457994644658 * y * (4 * zz - xx - yy);
    basis[12] = 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy);
    basis[13] = -0.4570457994644658 * x * (4 * zz - xx - yy);
    basis[14] = 1.445305721320277 * z * (xx - yy);
    basis[15] = -0.5900435899266435 * x * (xx - 3 * yy);
    let red = 0.5, green = 0.5, blue = 0.5;
    for (let k = 0; k < terms; ++k, h += 3) {
      red += basis[k] * harmonics[h];
      green += basis[k] * harmonics[h + 1];
      blue += basis[k] * harmonics[h + 2];
    }
    if (shift && response) {
      red += shift[0] * response[n];
      green += shift[1] * response[n];
      blue += shift[2] * response[n];
    }
    colors[3 * n] = Math.max(0, red);
    colors[3 * n + 1] = Math.max(0, green);
    colors[3 * n + 2] = Math.max(0, blue);
  }
}
