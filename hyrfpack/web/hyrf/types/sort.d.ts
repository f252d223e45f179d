/** Sorts the same splats again and again, in memory that is allocated once. */
export declare class DepthSort {
    positions: Float32Array<ArrayBufferLike>;
    width: number;
    units: number[] | undefined;
    count: number;
    capacity: number;
    depths: Float32Array<ArrayBuffer>;
    bits: Uint32Array<ArrayBuffer>;
    indices: Uint32Array<ArrayBuffer>;
    others: Uint32Array<ArrayBuffer>;
    counts: Uint32Array<ArrayBuffer>;
    /**
     * @param {Float32Array} positions those of the splats (3 N); those with NaN are omitted
     * @param {number} width orders fill whole rows of a texture that is `width` texels wide
     * @param {number[]} [units] for each row, a factor of the depth of the near plane; 1 by default
     */
    constructor(positions: Float32Array, width: number, units?: number[]);
    /**
     * Sorts by a radix sort of the float32 depths in two passes of 16 bits. Splats nearer than the near plane or outside
     * the planes `sides` are omitted. At equal depth the splat with the larger index comes first, as in the rasteriser.
     * @param {number[]} row the third row of the camera's pose
     * @param {number[]} sides from `frustumPlanes`
     * @param {number} near the depth of the near plane, before the factors `units`
     * @param {Uint32Array | null} [order] an array to reuse, if its length fits
     * @param {Uint8Array | null} [kept] 0 for each splat to omit
     * @returns {{order: Uint32Array, drawn: number}} indices of splats, of which the first `drawn` are valid
     */
    sort(row: number[], sides: number[], near: number, order?: Uint32Array | null, kept?: Uint8Array | null): {
        order: Uint32Array;
        drawn: number;
    };
}
