// Drawing: sorted Gaussians into pictures, and pictures onto the canvas.
//
// Pictures are premultiplied and without a background; their first row is the uppermost.

import {ROW} from "./shape.js";

const SPLAT_VERTEX = `#version 300 es
#define ROW ${ROW}
uniform highp sampler2D instances;  // u, v, slope, a; c, lift, half height, half width; color
uniform vec2 size;
flat out vec4 f_place;
flat out vec2 f_shape;
flat out vec3 f_color;
void main() {
  // Two triangles of vertices that are all alike: some drivers draw each instance by itself.
  int splat = gl_VertexID / 6, n = gl_VertexID % 6, side = n < 3 ? n : 6 - n;
  ivec2 first = ivec2(splat % ROW * 3, splat / ROW);
  vec4 place = texelFetch(instances, first, 0), shape = texelFetch(instances, first + ivec2(1, 0), 0);
  vec2 corner = vec2(side & 1, side >> 1) * 2.0 - 1.0;
  float dy = corner.y * shape.z;
  vec2 at = place.xy + vec2(place.z * dy + corner.x * shape.w, dy);
  gl_Position = vec4(at / size * 2.0 - 1.0, 0.0, 1.0);
  f_place = place;
  f_shape = shape.xy;
  f_color = texelFetch(instances, first + ivec2(2, 0), 0).rgb;
}`;
const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
flat in vec4 f_place;
flat in vec2 f_shape;
flat in vec3 f_color;
out vec4 result;
void main() {
  vec2 d = gl_FragCoord.xy - f_place.xy;
  float e = d.x - d.y * f_place.z;
  float alpha = min(exp2(f_shape.y + e * e * f_place.w + d.y * d.y * f_shape.x), 0.99);
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(f_color * alpha, alpha);
}`;
const FULL_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;
const MEAN_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D points;
uniform int side;
out vec4 result;
void main() {
  vec4 sum = vec4(0.0);
  ivec2 first = ivec2(gl_FragCoord.xy) * side;
  for (int y = 0; y < side; ++y)
    for (int x = 0; x < side; ++x) sum += texelFetch(points, first + ivec2(x, y), 0);
  sum /= float(side * side);
  result = vec4(sum.rgb, 1.0 - sum.a);  // the target's alpha is what passes through
}`;
const SHOW_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D left, right, scale;
uniform vec2 size;
uniform vec3 background;
uniform int mode;  // 0 left, 1 slider, 2 side by side, 3 difference
uniform float split, most;
out vec4 result;
vec3 over(sampler2D picture, vec2 at) {
  vec4 own = texture(picture, at);
  return clamp(own.rgb + (1.0 - own.a) * background, 0.0, 1.0);
}
vec3 cieluv(vec3 srgb) {  // as reports/pictures/cieluv.py has it
  vec3 light = mix(srgb / 12.92, pow((srgb + 0.055) / 1.055, vec3(2.4)), step(0.04045, srgb));
  vec3 xyz = mat3(0.4124, 0.2126, 0.0193, 0.3576, 0.7152, 0.1192, 0.1805, 0.0722, 0.9505) * light;
  float L = xyz.y > 216.0 / 24389.0 ? 116.0 * pow(xyz.y, 1.0 / 3.0) - 16.0 : 24389.0 / 27.0 * xyz.y;
  float total = xyz.x + 15.0 * xyz.y + 3.0 * xyz.z;
  if (total <= 0.0) return vec3(0.0);
  vec2 white = vec2(4.0 * 0.3127, 9.0 * 0.3290) / (-2.0 * 0.3127 + 12.0 * 0.3290 + 3.0);
  return vec3(L, 13.0 * L * (vec2(4.0 * xyz.x, 9.0 * xyz.y) / total - white));
}
void main() {
  vec2 at = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) / size;
  vec3 color;
  if (mode == 3) {
    float apart = distance(cieluv(over(left, at)), cieluv(over(right, at)));
    color = texelFetch(scale, ivec2(int(clamp(apart / most, 0.0, 1.0) * 255.0 + 0.5), 0), 0).rgb;
  } else if (mode == 2) {
    vec2 own = vec2(fract(at.x * 2.0), at.y);
    color = at.x < 0.5 ? over(left, own) : over(right, own);
  } else {
    float line = split * size.x;
    color = mode == 0 || gl_FragCoord.x < line ? over(left, at) : over(right, at);
    if (mode == 1 && abs(gl_FragCoord.x - line) < 1.0) color = vec3(1.0, 0.55, 0.0);
  }
  result = vec4(color, 1.0);
}`;

/** A picture on the graphics card. */
class Picture {
  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
    this.texture = gl.createTexture();
    this.width = this.height = 0;
  }

  /**
   * Give it a size, and values if there are any.
   * @param {number} width @param {number} height @param {number} format sized, of floats
   * @param {Uint16Array | Float32Array | null} values RGBA: halves, or floats as the format says
   */
  fill(width, height, format, values = null) {
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    if (values === null && this.width === width && this.height === height && this.format === format) return;
    const type = format === gl.RGBA32F ? gl.FLOAT : gl.HALF_FLOAT;
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, gl.RGBA, type, values);
    const linear = format === gl.RGBA16F || gl.getExtension("OES_texture_float_linear");
    const filter = linear ? gl.LINEAR : gl.NEAREST;
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, filter);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    [this.width, this.height, this.format] = [width, height, format];
  }
}

/** Draws on one canvas. */
export class Painter {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {number[]} scale 256 colors of differences @param {number} most the greatest of them
   * @throws {Error} the browser cannot draw
   */
  constructor(canvas, scale, most) {
    const gl = canvas.getContext("webgl2", {alpha: false, antialias: false});
    if (!gl) throw new Error("This browser has no WebGL 2: update it, or switch hardware acceleration on.");
    if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float")) {
      throw new Error("This graphics card draws no half floats: use another browser, or a newer driver.");
    }
    this.gl = gl;
    this.format = gl.getExtension("EXT_float_blend") ? gl.RGBA32F : gl.RGBA16F;
    const about = gl.getExtension("WEBGL_debug_renderer_info");
    const name = String(gl.getParameter(about ? about.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    /** Whether the processor stands in for a graphics card: then splats.js blends. */
    this.software = /swiftshader|llvmpipe|software|basic render/i.test(name);
    this.most = most;
    this.splats = this.program(SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.mean = this.program(FULL_VERTEX, MEAN_FRAGMENT);
    this.show = this.program(FULL_VERTEX, SHOW_FRAGMENT);
    this.instances = new Picture(gl);
    this.target = new Picture(gl);
    this.frame = gl.createFramebuffer();
    this.scale = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.scale);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, 256, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, new Uint8Array(scale));
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.DITHER);
  }

  /** @param {string} vertex @param {string} fragment */
  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      const why = gl.getAttachedShaders(program).map((one) => gl.getShaderInfoLog(one)).join(" ");
      throw new Error(`This graphics card refuses a shader (${why.trim()}): use another browser.`);
    }
    return {program, at: (/** @type {string} */ name) => gl.getUniformLocation(program, name)};
  }

  picture() { return new Picture(this.gl); }

  /** @param {Picture | null} picture null: the canvas @param {number} width @param {number} height */
  onto(picture, width, height) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, picture && this.frame);
    if (picture) {
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture.texture, 0);
    }
    gl.viewport(0, 0, width, height);
  }

  /**
   * Blend Gaussians near to far: color grows by what still passes through, which is kept in alpha.
   * @param {Picture} to @param {{values: Float32Array, count: number, points: number}} sorted
   * @param {number} width @param {number} height
   */
  blend(to, {values, count, points}, width, height) {
    const gl = this.gl, across = points * width, down = points * height;
    this.target.fill(across, down, this.format);
    to.fill(width, height, gl.RGBA16F);
    this.onto(this.target, across, down);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(this.splats.program);
    gl.uniform2f(this.splats.at("size"), across, down);
    gl.uniform1i(this.splats.at("instances"), 0);
    if (count) this.instances.fill(3 * ROW, values.length / (12 * ROW), gl.RGBA32F, values);
    gl.enable(gl.BLEND);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.DST_ALPHA, gl.ONE, gl.ZERO, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.TRIANGLES, 0, 6 * count);
    gl.disable(gl.BLEND);
    this.onto(to, width, height);
    gl.useProgram(this.mean.program);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.target.texture);
    gl.uniform1i(this.mean.at("side"), points);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /**
   * Show pictures on the canvas.
   * @param {Picture} left @param {Picture} right
   * @param {{mode: number, split: number, background: number[]}} how
   */
  present(left, right, {mode, split, background}) {
    const gl = this.gl, {width, height} = gl.canvas;
    this.onto(null, width, height);
    gl.useProgram(this.show.program);
    [left.texture, right.texture, this.scale].forEach((texture, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    ["left", "right", "scale"].forEach((name, unit) => gl.uniform1i(this.show.at(name), unit));
    gl.activeTexture(gl.TEXTURE0);
    gl.uniform2f(this.show.at("size"), width, height);
    gl.uniform3fv(this.show.at("background"), background);
    gl.uniform1i(this.show.at("mode"), mode);
    gl.uniform1f(this.show.at("split"), split);
    gl.uniform1f(this.show.at("most"), this.most);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Wait until all that was asked for is drawn. */
  async finished() {
    const gl = this.gl, fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) await new Promise((done) => setTimeout(done, 1));
    gl.deleteSync(fence);
  }

  /** @param {Picture} picture @returns {Float32Array} RGBA by rows, from the uppermost */
  read(picture) {
    const values = new Float32Array(4 * picture.width * picture.height);
    this.onto(picture, picture.width, picture.height);
    this.gl.readPixels(0, 0, picture.width, picture.height, this.gl.RGBA, this.gl.FLOAT, values);
    return values;
  }
}
