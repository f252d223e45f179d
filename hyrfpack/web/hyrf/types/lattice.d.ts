export type LatticePoints = {
    centers: Int32Array;
    classes: Uint8Array;
    count: number;
};
/** Centres of cells are given in units of 2^-CENTER_BITS_PER_AXIS of the cube's edge. */
export declare const CENTER_BITS_PER_AXIS: number;
/**
 * Decodes the points of a layer.
 * @param {Uint8Array} data the bytes of the section
 * @param {number} count the number of points
 * @returns {LatticePoints}
 * @throws {DamagedData} a length or a number is invalid, or a point lies outside the cube
 */
export declare const decodeLattice: (data: Uint8Array, count: number) => LatticePoints;
/**
 * Computes the positions of lattice points by the inverse of the contraction, in float64, and rounds them to float32.
 * @param {LatticePoints} points
 * @param {number[]} halfExtent the frame's half extents in local units
 * @returns {Float32Array} (3 N), local units
 */
export declare const latticePositions: ({ centers, count }: LatticePoints, [width, height, depth]: number[]) => Float32Array;
