/** The number 1 in fixed point. The unit of fixed-point numbers is 1 / FIXED_POINT_ONE. */
export declare const FIXED_POINT_ONE: number;
/** The quantisation step for each code, in fixed point. */
export declare const STEP_BY_CODE: Float64Array<ArrayBuffer>;
