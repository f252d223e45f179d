export type Entry = import("./container.js").Entry;
export type ExposureMap = import("./exposure.js").ExposureMap;
export type FieldName = import("./grids.js").FieldName;
export type LatticePoints = import("./lattice.js").LatticePoints;
export type Config = import("./metadata.js").Config;
export type Metadata = import("./metadata.js").Metadata;
export type Field = {
    table: Float32Array;
    decoder: Float32Array;
};
export type Model = {
    metadata: Metadata;
    config: Config;
    count: number;
    layers: number[];
    whole: boolean;
    positions: Float32Array;
    colorLogits: Float32Array;
    scaleLogits: Float32Array;
    opacityLogits: Float32Array;
    shapeResiduals: Float32Array | null;
    colorResiduals: Float32Array | null;
    geometry: Field;
    radiance: Field;
    exposure: ExposureMap | null;
};
export type Description = {
    version: [number, number];
    length: number;
    sections: {
        type: string;
        codec: number;
        offset: number;
        stored: number;
        raw: number;
    }[];
    firstLayer: number;
};
export type OpenFile = (name: string) => Uint8Array | Promise<Uint8Array>;
export type ExpectedSection = {
    type: string;
    group: string;
    layer: number;
    rows: number;
    columns: number;
};
/** See `describe` of index.js. @type {typeof import("./index.js").describe} */
export declare const describeFile: typeof import("./index.js").describe;
/** See `read` of index.js. @type {typeof import("./index.js").read} */
export declare const readFile: typeof import("./index.js").read;
/** See `readParts` of index.js. @type {typeof import("./index.js").readParts} */
export declare const readFileParts: typeof import("./index.js").readParts;
