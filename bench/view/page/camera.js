// The camera, and how mouse, fingers and keys move it.
//
// Axes are OpenCV's: x right, y down, z forward. A matrix is camera to world, 16 numbers by rows.

const ORBIT = 0.006; // radians a pixel
const STEP = 0.05; // of the distance to the centre, a key press
const TURN = 0.08; // radians, a key press

/** A pinhole camera that turns about a centre; it knows no size of pictures. */
export class View {
  constructor() {
    this.matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, -3, 0, 0, 0, 1];
    this.centre = [0, 0, 0];
    this.focal = [1.87, 1.87]; // in shorter sides of the picture
    this.shift = [0, 0]; // of the principal point from the middle, likewise
    this.near = 0.15;
    this.distance = 3; // to the centre, where `near` holds
  }

  /**
   * Stand where a bookmark stands.
   * @param {import("./splats.js").Camera} camera @param {number[]} centre
   */
  stand(camera, centre) {
    const side = Math.min(camera.width, camera.height);
    this.matrix = [...camera.matrix];
    this.centre = [...centre];
    this.focal = [camera.fx / side, camera.fy / side];
    this.shift = [(camera.cx - 0.5 * camera.width) / side, (camera.cy - 0.5 * camera.height) / side];
    this.near = camera.near;
    this.distance = this.away();
  }

  /** @param {number} width @param {number} height @returns {import("./splats.js").Camera} */
  at(width, height) {
    const side = Math.min(width, height);
    return {
      matrix: [...this.matrix], width, height,
      fx: this.focal[0] * side, fy: this.focal[1] * side,
      cx: 0.5 * width + this.shift[0] * side, cy: 0.5 * height + this.shift[1] * side,
      near: this.near * Math.min(1, this.away() / this.distance),
    };
  }

  place() { return [3, 7, 11].map((i) => this.matrix[i]); }

  axis(/** @type {number} */ which) { return [0, 4, 8].map((i) => this.matrix[i + which]); }

  away() { return Math.hypot(...this.place().map((one, i) => one - this.centre[i])) || 1e-6; }

  /** Turn about an axis through a point. @param {number[]} axis unit @param {number} angle @param {number[]} about */
  turn(axis, angle, about) {
    const [x, y, z] = axis, c = Math.cos(angle), s = Math.sin(angle), d = 1 - c;
    const rows = [
      [c + x * x * d, x * y * d - z * s, x * z * d + y * s],
      [y * x * d + z * s, c + y * y * d, y * z * d - x * s],
      [z * x * d - y * s, z * y * d + x * s, c + z * z * d],
    ];
    const turned = (/** @type {number[]} */ v) => rows.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
    const place = turned(this.place().map((one, i) => one - about[i])).map((one, i) => one + about[i]);
    let [right, down] = [turned(this.axis(0)), turned(this.axis(1))];
    // Kept orthonormal, however often it turns.
    right = unit(right);
    const along = dot(right, down);
    down = unit(down.map((one, i) => one - along * right[i]));
    const forward = cross(right, down);
    for (let i = 0; i < 3; ++i) this.matrix.splice(4 * i, 4, right[i], down[i], forward[i], place[i]);
  }

  /** Around the centre, by pixels of a drag. */
  orbit(/** @type {number} */ dx, /** @type {number} */ dy) {
    this.turn(this.axis(1), dx * ORBIT, this.centre);
    this.turn(this.axis(0), -dy * ORBIT, this.centre);
  }

  /** Camera and centre together, in the camera's axes, scene units. @param {number[]} by */
  move(by) {
    for (let i = 0; i < 3; ++i) {
      const step = [0, 1, 2].reduce((sum, k) => sum + by[k] * this.matrix[4 * i + k], 0);
      this.matrix[4 * i + 3] += step;
      this.centre[i] += step;
    }
  }

  /** So that what lies at the centre follows a drag. @param {number} side shorter side of the picture, px */
  pan(/** @type {number} */ dx, /** @type {number} */ dy, side) {
    const size = this.away() / (this.focal[0] * side);
    this.move([-dx * size, -dy * size, 0]);
  }

  /** Towards the centre: the distance is multiplied. */
  zoom(/** @type {number} */ factor) {
    for (let i = 0; i < 3; ++i) {
      this.matrix[4 * i + 3] = this.centre[i] + factor * (this.matrix[4 * i + 3] - this.centre[i]);
    }
  }
}

const dot = (/** @type {number[]} */ a, /** @type {number[]} */ b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const unit = (/** @type {number[]} */ a) => a.map((one) => one / Math.sqrt(dot(a, a)));
const cross = (/** @type {number[]} */ a, /** @type {number[]} */ b) =>
  [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** @type {Record<string, (view: View) => void>} */
const KEYS = {
  ArrowLeft: (view) => view.turn(view.axis(1), TURN, view.centre),
  ArrowRight: (view) => view.turn(view.axis(1), -TURN, view.centre),
  ArrowUp: (view) => view.turn(view.axis(0), -TURN, view.centre),
  ArrowDown: (view) => view.turn(view.axis(0), TURN, view.centre),
  "+": (view) => view.zoom(1 / 1.1),
  "-": (view) => view.zoom(1.1),
  w: (view) => view.move([0, 0, STEP * view.away()]),
  s: (view) => view.move([0, 0, -STEP * view.away()]),
  a: (view) => view.move([-STEP * view.away(), 0, 0]),
  d: (view) => view.move([STEP * view.away(), 0, 0]),
  e: (view) => view.move([0, -STEP * view.away(), 0]),
  c: (view) => view.move([0, STEP * view.away(), 0]),
  q: (view) => view.turn(view.axis(2), -TURN, view.place()),
  x: (view) => view.turn(view.axis(2), TURN, view.place()),
};

/**
 * Let an element move a view.
 * @param {HTMLElement} element that has the focus for keys
 * @param {View} view
 * @param {() => void} changed
 */
export function steer(element, view, changed) {
  const fingers = new Map();
  const spread = () => {
    const [a, b] = [...fingers.values()];
    return {x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(a.x - b.x, a.y - b.y) || 1};
  };
  element.addEventListener("pointerdown", (event) => {
    if (event.target !== element) return;
    element.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, {x: event.clientX, y: event.clientY});
  });
  element.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const side = Math.min(element.clientWidth, element.clientHeight);
    const dx = event.clientX - last.x, dy = event.clientY - last.y;
    if (fingers.size === 2) {
      const before = spread();
      fingers.set(event.pointerId, {x: event.clientX, y: event.clientY});
      const after = spread();
      view.pan(after.x - before.x, after.y - before.y, side);
      view.zoom(before.apart / after.apart);
    } else {
      fingers.set(event.pointerId, {x: event.clientX, y: event.clientY});
      if (event.shiftKey || event.buttons & 6) view.pan(dx, dy, side);
      else view.orbit(dx, dy);
    }
    changed();
  });
  for (const name of ["pointerup", "pointercancel"]) {
    element.addEventListener(name, (event) => fingers.delete(event.pointerId));
  }
  element.addEventListener("contextmenu", (event) => event.preventDefault());
  element.addEventListener("wheel", (event) => {
    event.preventDefault();
    view.zoom(Math.exp(Math.max(-0.5, Math.min(0.5, event.deltaY * 0.001))));
    changed();
  }, {passive: false});
  element.addEventListener("keydown", (event) => {
    const act = KEYS[event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act(view);
    changed();
  });
}
