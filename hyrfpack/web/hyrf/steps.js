// Step sizes (docs/format.md 3.2).

/** Numbers in fixed point count units of 1 / FIXED_ONE. */
export const FIXED_ONE = 2 ** 24;

/** The step, in these units, of each byte that stands for one. */
export const STEP_OF_CODE = Float64Array.from({ length: 256 }, (_, code) => (8 + (code & 7)) * 2 ** (code >> 3));
