// Evaluates spherical harmonics.

/** The harmonic of degree 0, which is constant: 1 / (2 sqrt(pi)). */
export const SH_BAND_0 = 0.28209479177387814;

/**
 * Evaluates the real spherical harmonics of a direction with the Condon-Shortley phase, the convention of splat files.
 * @param {number} degree the largest degree, 0 to 3
 * @param {number} x
 * @param {number} y
 * @param {number} z
 * @param {Float64Array} basis receives (degree + 1)^2 numbers
 * @param {number} [at] the index of the first of them
 */
export function evaluateBasis(degree, x, y, z, basis, at = 0) {
  basis[at] = SH_BAND_0;
  if (degree < 1) return;
  basis[at + 1] = -0.4886025119029199 * y;
  basis[at + 2] = 0.4886025119029199 * z;
  basis[at + 3] = -0.4886025119029199 * x;
  if (degree < 2) return;
  const xx = x * x, yy = y * y, zz = z * z;
  basis[at + 4] = 1.0925484305920792 * x * y;
  basis[at + 5] = -1.0925484305920792 * y * z;
  basis[at + 6] = 0.31539156525252005 * (3 * zz - 1);
  basis[at + 7] = -1.0925484305920792 * x * z;
  basis[at + 8] = 0.5462742152960396 * (xx - yy);
  if (degree < 3) return;
  basis[at + 9] = -0.5900435899266435 * y * (3 * xx - yy);
  basis[at + 10] = 2.890611442640554 * x * y * z;
  basis[at + 11] = -0.4570457994644658 * y * (5 * zz - 1);
  basis[at + 12] = 0.3731763325901154 * z * (5 * zz - 3);
  basis[at + 13] = -0.4570457994644658 * x * (5 * zz - 1);
  basis[at + 14] = 1.445305721320277 * z * (xx - yy);
  basis[at + 15] = -0.5900435899266435 * x * (xx - 3 * yy);
}
