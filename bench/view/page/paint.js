// Blending sorted Gaussians without a graphics card: what software that stands in for one does ten times slower.
//
// Along a row of points log(alpha) is a square polynomial, so that alpha follows by two products a point.

import {STRIDE} from "./shape.js";

const MAX_ALPHA = 0.99, MIN_ALPHA = 1 / 255;
const MIN_THROUGH = 1e-4; // a point ends where less than this would pass through
const BAND = 1 << 18; // bytes of points that are blended together: what caches hold

let state = new Float32Array(0); // by point: what passes through (negative: it has ended), and colors

/**
 * @param {Float32Array} instances near to far, as splats.js makes them @param {number} count
 * @param {number} width @param {number} height of the picture @param {number} points along a side of a pixel
 * @returns {Float32Array} RGBA by pixels, premultiplied
 */
export function painted(instances, count, width, height, points) {
  const across = width * points, pixels = new Float32Array(4 * width * height);
  const rows = Math.max(1, Math.floor(BAND / (16 * across * points))); // of pixels
  const bounds = new Int32Array(2 * count); // rows of points that a Gaussian reaches
  for (let k = 0, o = 0; k < count; ++k, o += STRIDE) {
    bounds[2 * k] = Math.ceil(instances[o + 1] - instances[o + 6] - 0.5);
    bounds[2 * k + 1] = Math.floor(instances[o + 1] + instances[o + 6] - 0.5);
  }
  for (let start = 0; start < height; start += rows) {
    const end = Math.min(height, start + rows);
    band(instances, bounds, across, start * points, end * points);
    means(pixels, width, start, end, points);
  }
  return pixels;
}

/** Blend all Gaussians in rows of points from `top` on. */
function band(/** @type {Float32Array} */ instances, /** @type {Int32Array} */ bounds, across, top, bottom) {
  const size = 4 * across * (bottom - top);
  if (state.length < size) state = new Float32Array(size);
  state.fill(0, 0, size);
  for (let i = 0; i < size; i += 4) state[i] = 1;
  for (let k = 0; 2 * k < bounds.length; ++k) {
    const first = Math.max(top, bounds[2 * k]), last = Math.min(bottom - 1, bounds[2 * k + 1]);
    if (first > last) continue;
    const o = STRIDE * k;
    const u = instances[o], v = instances[o + 1], slope = instances[o + 2], a = instances[o + 3] * Math.LN2;
    const c = instances[o + 4] * Math.LN2, lift = instances[o + 5] * Math.LN2, half = instances[o + 7];
    const red = instances[o + 8], green = instances[o + 9], blue = instances[o + 10];
    const bend = Math.exp(2 * a), inverse = 1 / (instances[o + 6] * instances[o + 6]);
    for (let y = first; y <= last; ++y) {
      const dy = y + 0.5 - v, middle = u + slope * dy, reach = half * Math.sqrt(Math.max(0, 1 - dy * dy * inverse));
      const left = Math.max(0, Math.ceil(middle - reach - 0.5));
      const right = Math.min(across - 1, Math.floor(middle + reach - 0.5));
      if (left > right) continue;
      const e = left + 0.5 - middle;
      let alpha = Math.exp(lift + a * e * e + c * dy * dy), ratio = Math.exp(a * (2 * e + 1));
      const stop = 4 * ((y - top) * across + right);
      for (let i = 4 * ((y - top) * across + left); i <= stop; i += 4, alpha *= ratio, ratio *= bend) {
        const through = state[i];
        if (through < 0 || alpha < MIN_ALPHA) continue;
        const own = alpha < MAX_ALPHA ? alpha : MAX_ALPHA, after = through - own * through;
        if (after < MIN_THROUGH) {
          state[i] = -through;
          continue;
        }
        const weight = own * through;
        state[i] = after;
        state[i + 1] += weight * red;
        state[i + 2] += weight * green;
        state[i + 3] += weight * blue;
      }
    }
  }
}

/** Pixels of rows `start` to `end` from the points of a band. */
function means(/** @type {Float32Array} */ pixels, width, start, end, points) {
  const across = width * points, share = 1 / (points * points);
  for (let y = start, to = 4 * width * start; y < end; ++y) {
    for (let x = 0; x < width; ++x, to += 4) {
      let through = 0, red = 0, green = 0, blue = 0;
      for (let q = 0; q < points; ++q) {
        let i = 4 * (((y - start) * points + q) * across + x * points);
        for (let p = 0; p < points; ++p, i += 4) {
          through += Math.abs(state[i]);
          red += state[i + 1];
          green += state[i + 2];
          blue += state[i + 3];
        }
      }
      pixels[to] = red * share;
      pixels[to + 1] = green * share;
      pixels[to + 2] = blue * share;
      pixels[to + 3] = 1 - through * share;
    }
  }
}
