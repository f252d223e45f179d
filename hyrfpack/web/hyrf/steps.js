// Defines the quantisation steps (docs/reference/format.md 3.2).

/** The number 1 in fixed point. The unit of fixed-point numbers is 1 / FIXED_POINT_ONE. */
export const FIXED_POINT_ONE = 2 ** 24;

/** The quantisation step for each code, in fixed point. */
export const STEP_BY_CODE = Float64Array.from({ length: 256 }, (_, code) => (8 + (code & 7)) * 2 ** (code >> 3));
