export type ExposureMap = {
    box: Float32Array;
    lengths: Float32Array;
    mean: Float32Array;
    limits: Float32Array;
    centers: {
        position: number[];
        direction: number[];
        weight: number[];
    }[];
};
/**
 * Decodes an exposure map (codec 9).
 * @param {Uint8Array} data the bytes of the section
 * @param {number} rawLength the section's decoded length in bytes, from the table of contents
 * @returns {ExposureMap}
 * @throws {DamagedData} a length or a number is invalid
 */
export declare const decodeExposure: (data: Uint8Array, rawLength: number) => ExposureMap;
/**
 * Computes the log gains of a viewpoint, in float64:
 *
 *     clip(mean + sum over centers of weight / (1 + |x' - position|^2 / lengths[0]^2
 *                                                 + |f - direction|^2 / lengths[1]^2))
 *
 * where x' is the point of `box` nearest to the viewpoint and f is the viewing direction. A channel y of the picture is
 * displayed as g y / (1 + (g - 1) y) with g = exp(log gain).
 * @param {ExposureMap} exposure
 * @param {ArrayLike<number>} position 3 numbers, local units
 * @param {ArrayLike<number>} direction 3 numbers, unit length
 * @returns {number[]} 3 numbers, of red, green and blue, within `limits`
 */
export declare const logGains: ({ box, lengths, mean, limits, centers }: ExposureMap, position: ArrayLike<number>, direction: ArrayLike<number>) => number[];
