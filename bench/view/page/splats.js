// A worker that holds the Gaussians of one model, projects them and sorts them near to far.
//
// The arithmetic is that of native/kernels/project.h, in double as there. What is posted back, 12 floats a
// Gaussian, is what the shader of gl.js takes: centre (px), coefficients of log2(alpha) = lift + a e^2 + c dy^2
// with e = dx - slope dy, half the height of the ellipse on which alpha is 1/255, half its width, color.

import {painted} from "./paint.js";
import {ask} from "./server.js";
import {ROW, STRIDE} from "./shape.js";

const CLAMP = 1.3; // of half a field of view, for the Jacobian
const MIN_ALPHA = 1 / 255;
const MIN_THROUGH = 1e-4; // least transmittance of a Gaussian whose depth is changed
const MAX_DEPTH = Math.log(50); // of the relative depth of a Gaussian along a ray
const MIN_AREAS = 1e-60;

/**
 * @typedef {object} Camera as bench/view/sources.py writes it
 * @property {number[]} matrix camera to world, 16 by rows
 * @property {number} fx @property {number} fy @property {number} cx @property {number} cy
 * @property {number} width @property {number} height @property {number} near
 */

/** Gaussians of one view, and what of them does not depend on the camera. */
class Gaussians {
  /** @param {any} answer of the route `splats` */
  constructor(answer) {
    this.filter = answer; // variance, compensated, rayPower, points, and the key of all but colors
    this.means = answer.means;
    this.colors = answer.colors;
    this.opacities = answer.opacities;
    const count = this.count = answer.opacities.length;
    const axes = this.axes = new Float64Array(9 * count); // columns of rotation times scale
    const areas = this.areas = new Float64Array(count); // log of the mean square of the areas along the axes
    for (let n = 0; n < count; ++n) {
      let [w, x, y, z] = answer.quats.subarray(4 * n, 4 * n + 4);
      const inverse = 1 / Math.hypot(w, x, y, z);
      w *= inverse; x *= inverse; y *= inverse; z *= inverse;
      const p = answer.scales[3 * n], q = answer.scales[3 * n + 1], r = answer.scales[3 * n + 2];
      axes.set([
        p * (1 - 2 * (y * y + z * z)), p * 2 * (x * y + w * z), p * 2 * (x * z - w * y),
        q * 2 * (x * y - w * z), q * (1 - 2 * (x * x + z * z)), q * 2 * (y * z + w * x),
        r * 2 * (x * z + w * y), r * 2 * (y * z - w * x), r * (1 - 2 * (x * x + y * y)),
      ], 9 * n);
      const pp = p * p, qq = q * q, rr = r * r;
      areas[n] = Math.log(Math.max((qq * rr + pp * (qq + rr)) / 3, MIN_AREAS));
    }
    this.projected = new Float32Array(STRIDE * count);
    this.depths = new Float32Array(count);
  }

  /**
   * @param {Camera} camera
   * @param {number} variance of the filter on the image, in squared pixels of the camera
   * @param {number} least opacity: Gaussians below it are left out
   * @returns {{instances: Float32Array, count: number}} near to far; count without those out of the picture
   */
  seen(camera, variance, least) {
    const {fx, fy, cx, cy, width, height, near, matrix: m} = camera;
    const {means, axes, areas, opacities, colors, projected, depths} = this;
    const {compensated, rayPower} = this.filter;
    const limitX = CLAMP * 0.5 * width / fx, limitY = CLAMP * 0.5 * height / fy;
    // Rows of world to camera are columns of camera to world.
    const [ax, bx, gx, px, ay, by, gy, py, az, bz, gz, pz] = m;
    let shown = 0;
    for (let n = 0; n < this.count; ++n) {
      const own = opacities[n];
      if (own < least) continue;
      const x = means[3 * n] - px, y = means[3 * n + 1] - py, z = means[3 * n + 2] - pz;
      const depth = gx * x + gy * y + gz * z;
      if (!(depth > near && depth < 1e30)) continue;
      const inverse = 1 / depth;
      const tx = (ax * x + ay * y + az * z) * inverse, ty = (bx * x + by * y + bz * z) * inverse;
      const sx = Math.max(Math.min(tx, limitX), -limitX), sy = Math.max(Math.min(ty, limitY), -limitY);
      const f = fx * inverse, g = fy * inverse;
      const k0 = f * (ax - sx * gx), k1 = f * (ay - sx * gy), k2 = f * (az - sx * gz);
      const l0 = g * (bx - sy * gx), l1 = g * (by - sy * gy), l2 = g * (bz - sy * gz);
      const i = 9 * n;
      const m0 = k0 * axes[i] + k1 * axes[i + 1] + k2 * axes[i + 2];
      const m1 = k0 * axes[i + 3] + k1 * axes[i + 4] + k2 * axes[i + 5];
      const m2 = k0 * axes[i + 6] + k1 * axes[i + 7] + k2 * axes[i + 8];
      const n0 = l0 * axes[i] + l1 * axes[i + 1] + l2 * axes[i + 2];
      const n1 = l0 * axes[i + 3] + l1 * axes[i + 4] + l2 * axes[i + 5];
      const n2 = l0 * axes[i + 6] + l1 * axes[i + 7] + l2 * axes[i + 8];
      const aa = m0 * m0 + m1 * m1 + m2 * m2, cc = n0 * n0 + n1 * n1 + n2 * n2;
      const b = m0 * n0 + m1 * n1 + m2 * n2;
      const c0 = m1 * n2 - m2 * n1, c1 = m2 * n0 - m0 * n2, c2 = m0 * n1 - m1 * n0;
      const before = c0 * c0 + c1 * c1 + c2 * c2;
      const det = before + variance * (aa + cc) + variance * variance;
      const a = aa + variance, c = cc + variance;
      let opacity = own;
      if (rayPower > 0) { // a sheet is darker seen edge-on
        const d0 = k1 * l2 - k2 * l1, d1 = k2 * l0 - k0 * l2, d2 = k0 * l1 - k1 * l0;
        const across = Math.max(before / (d0 * d0 + d1 * d1 + d2 * d2), MIN_AREAS);
        const relative = 0.5 * (areas[n] - Math.log(across));
        const ray = Math.exp(rayPower * Math.min(relative, MAX_DEPTH));
        opacity = 1 - Math.exp(ray * Math.log(Math.max(1 - own, MIN_THROUGH)));
      }
      if (compensated) opacity *= Math.sqrt(before / det);
      if (!(opacity >= MIN_ALPHA)) continue;
      const bound = 2 * Math.log(255 * opacity) * (1 + 1e-4) + 1e-4; // rounding cuts no pixel off
      const u = fx * tx + cx, v = fy * ty + cy;
      const halfU = Math.sqrt(bound * a), halfV = Math.sqrt(bound * c);
      if (u + halfU < 0.5 || u - halfU > width - 0.5 || v + halfV < 0.5 || v - halfV > height - 0.5) continue;
      const o = STRIDE * shown;
      projected[o] = u;
      projected[o + 1] = v;
      projected[o + 2] = b / c;
      projected[o + 3] = -0.5 * Math.LOG2E * c / det;
      projected[o + 4] = -0.5 * Math.LOG2E / c;
      projected[o + 5] = Math.LOG2E * Math.log(opacity);
      projected[o + 6] = halfV;
      projected[o + 7] = Math.sqrt(bound * det / c);
      projected[o + 8] = colors[3 * n];
      projected[o + 9] = colors[3 * n + 1];
      projected[o + 10] = colors[3 * n + 2];
      depths[shown++] = depth;
    }
    const order = sorted(depths, shown);
    const instances = new Float32Array(STRIDE * ROW * Math.ceil(shown / ROW));
    for (let k = 0; k < shown; ++k) {
      const from = STRIDE * order[k];
      for (let q = 0; q < 11; ++q) instances[STRIDE * k + q] = projected[from + q];
    }
    return {instances, count: shown};
  }
}

/**
 * Places of positive numbers in ascending order, equal ones as they came: their bits sort as integers.
 * @param {Float32Array} values @param {number} count
 */
function sorted(values, count) {
  const keys = new Uint32Array(values.buffer, 0, count);
  let order = new Uint32Array(count), spare = new Uint32Array(count);
  for (let n = 0; n < count; ++n) order[n] = n;
  for (const shift of [0, 16]) {
    const places = new Uint32Array(65537);
    for (let n = 0; n < count; ++n) ++places[(keys[n] >>> shift & 65535) + 1];
    for (let n = 1; n < 65536; ++n) places[n] += places[n - 1];
    for (let n = 0; n < count; ++n) spare[places[keys[order[n]] >>> shift & 65535]++] = order[n];
    [order, spare] = [spare, order];
  }
  return order;
}

/** The filter where one point stands for k x k of a pixel (econgs/splat/low_pass.py). */
function coarser({variance, points}) {
  const squared = points * points;
  return variance / squared + (squared - 1) / (12 * squared);
}

let held = /** @type {Gaussians | null} */ (null);
let newest = 0;

const TASKS = {
  /** Take the Gaussians of a view from the server. */
  async load(/** @type {object} */ body) {
    const own = ++newest, before = held, answer = await ask("splats", {...body, has: before?.filter.key});
    if (own !== newest) return; // an older answer may come after a newer one
    if (answer.means) held = new Gaussians(answer);
    else Object.assign(before, {colors: answer.colors, filter: answer}), held = before;
  },

  /**
   * Project and sort, and without a graphics card blend.
   * @param {{camera: Camera, whole: boolean, least: number, paint: boolean}} wish `whole`: every point of a
   * pixel is drawn, not one that stands for them
   */
  async draw({camera, whole, least, paint}) {
    if (!held) return null;
    const points = whole ? held.filter.points : 1;
    const finer = {...camera, width: points * camera.width, height: points * camera.height};
    for (const name of ["fx", "fy", "cx", "cy"]) finer[name] = points * camera[name];
    const variance = whole ? held.filter.variance : coarser(held.filter);
    const {instances, count} = held.seen(finer, variance, least);
    if (paint) return {values: painted(instances, count, camera.width, camera.height, points), count};
    return {values: instances, count, points};
  },
};

self.onmessage = async ({data: {id, task, body}}) => {
  try {
    const answer = await TASKS[task](body);
    self.postMessage({id, answer}, answer?.values ? [answer.values.buffer] : []);
  } catch (error) {
    self.postMessage({id, error: error.message});
  }
};
