// The texture that carries sorted Gaussians from splats.js to gl.js.

/** Floats a Gaussian. */
export const STRIDE = 12;
/** Gaussians a row. */
export const ROW = 1024;
