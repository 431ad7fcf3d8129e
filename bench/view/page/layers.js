// What fills one of the two pictures of the page: Gaussians drawn here, or pictures that the server draws.

import {ask, worker} from "./server.js";

const COARSE = 96; // shorter side of pictures from the server while the camera moves, px
const PAUSE = 100; // ms between an answer of the server and the next question while the camera moves

/**
 * @typedef {object} Wish what is to be seen
 * @property {number} stamp grows with every change
 * @property {import("./splats.js").Camera} camera
 * @property {object} body of requests: source, scenes, edits, background
 * @property {number} least opacity of Gaussians that are shown
 */

/** A worker that answers in promises. */
class Task {
  constructor() {
    this.worker = worker();
    this.count = 0;
    this.waiting = new Map();
    this.worker.onmessage = ({data: {id, answer, error}}) => {
      const [done, failed] = this.waiting.get(id);
      this.waiting.delete(id);
      error ? failed(new Error(error)) : done(answer);
    };
  }

  /** Whoever waits gets null. */
  end() {
    this.worker.terminate();
    for (const [done] of this.waiting.values()) done(null);
  }

  /** @param {string} task @param {object} body @returns {Promise<any>} */
  ask(task, body) {
    const id = ++this.count;
    return new Promise((done, failed) => {
      this.waiting.set(id, [done, failed]);
      this.worker.postMessage({id, task, body});
    });
  }
}

/** One of the two pictures. */
export class Layer {
  /** @param {import("./gl.js").Painter} painter @param {() => void} changed called when there is more to show */
  constructor(painter, changed) {
    this.painter = painter;
    this.changed = changed;
    this.picture = painter.picture();
    this.picture.fill(1, 1, painter.gl.RGBA16F, new Uint16Array(4));
    this.source = /** @type {number | null} */ (null); // its place among the sources of the server
    this.route = "splats"; // or "picture", "truth"
    this.exact = -1; // stamp of what is shown in full quality
    this.asked = false; // for a moving camera
    this.came = 0; // when the last answer to that came
    this.busy = false; // in full quality
    this.scores = null;
    this.count = 0;
    this.error = "";
    this.task = /** @type {Task | null} */ (null);
  }

  /** Show something else from now on. @param {string} route */
  become(route) {
    this.route = route;
    this.exact = this.loaded = -1;
    this.scores = null;
    this.error = "";
    this.task?.end();
    this.task = route === "splats" ? new Task() : null;
    this.asked = this.busy = false;
  }

  /**
   * Draw for a moving camera: what is at hand, at a share of the size.
   * @param {Wish} wish @param {number} share
   */
  async quick(wish, share) {
    const {width, height} = wish.camera, least = Math.min(width, height);
    const by = this.task ? share : Math.min(1, COARSE / least);
    const camera = smaller(wish.camera, Math.max(1, Math.round(by * width)), Math.max(1, Math.round(by * height)));
    if (!this.asked && performance.now() - this.came > PAUSE) this.later(wish, camera);
    if (this.task) await this.splat(camera, false, wish.least);
  }

  /** Ask the server without waiting. @param {Wish} wish @param {import("./splats.js").Camera} camera */
  async later(wish, camera) {
    const task = this.task, route = this.route;
    this.asked = true;
    try {
      if (task) await task.ask("load", {...wish.body, camera: wish.camera});
      else {
        const answer = await ask(route, {...wish.body, camera, coarse: true});
        if (route === this.route) this.take(answer);
      }
      this.error = "";
    } catch (error) {
      this.error = error.message;
    }
    if (task === this.task && route === this.route) {
      this.asked = false;
      this.came = performance.now();
      this.changed();
    }
  }

  /** Draw in full quality, from what the server says of exactly this view. @param {Wish} wish */
  async full(wish) {
    const task = this.task, route = this.route;
    this.busy = true;
    try {
      if (task) {
        if (this.loaded !== wish.stamp) await task.ask("load", {...wish.body, camera: wish.camera});
        if (task !== this.task) return;
        this.loaded = wish.stamp;
        await this.splat(wish.camera, true, wish.least);
      } else {
        const answer = await ask(route, {...wish.body, camera: wish.camera});
        if (route !== this.route) return;
        this.take(answer);
      }
      this.error = "";
    } catch (error) {
      if (task !== this.task || route !== this.route) return;
      this.error = error.message;
    } finally {
      if (task === this.task && route === this.route) this.busy = false;
    }
    this.exact = wish.stamp;
  }

  /** @param {any} answer of the routes `picture` and `truth` */
  take(answer) {
    this.picture.fill(answer.width, answer.height, this.painter.gl.RGBA16F, answer.pixels);
    this.scores = answer.scores ?? null;
  }

  /** @param {import("./splats.js").Camera} camera @param {boolean} whole @param {number} least */
  async splat(camera, whole, least) {
    const task = this.task, paint = this.painter.software;
    const sorted = await task.ask("draw", {camera, whole, least, paint});
    if (!sorted || task !== this.task) return;
    this.count = sorted.count;
    if (paint) this.picture.fill(camera.width, camera.height, this.painter.gl.RGBA32F, sorted.values);
    else this.painter.blend(this.picture, sorted, camera.width, camera.height);
  }
}

/** The same view in another size. @param {import("./splats.js").Camera} camera */
function smaller(camera, width, height) {
  const x = width / camera.width, y = height / camera.height;
  return {...camera, width, height, fx: camera.fx * x, fy: camera.fy * y, cx: camera.cx * x, cy: camera.cy * y};
}
