export type Container = import("./container.js").Container;
export type Entry = import("./container.js").Entry;
export type JsonNode = import("./json.js").JsonNode;
export type JsonObject = import("./json.js").JsonObject;
export type Grid = import("./grids.js").Grid;
export type Frame = {
    center: number[];
    scale: number;
    half_extent: number[];
    rotation?: number[];
};
export type Config = {
    frame: Frame;
    geometry: Grid;
    radiance: Grid;
    hidden: number;
    background: boolean;
    solid: number[];
    scale_rule: "sum" | "product";
    scale_grows: boolean;
    direction_encoding: "sh" | "frequency";
    antialiased: boolean;
    position_gradients: boolean;
    residual_degree?: number;
};
export type Metadata = {
    gaussians: number;
    layers?: number[];
    config: Config;
    rules: Record<string, string | number>;
    profile: string;
    settings: Record<string, any>;
    provenance: Record<string, any>;
    writer: string;
};
export declare const MAX_QUAT_LENGTH_ERROR = 0.000001;
/**
 * Reads and checks the metadata of a file.
 * @param {Container} container
 * @returns {Metadata}
 * @throws {HyrfFormatError} it is absent, too long or not JSON, or a field is missing or invalid
 */
export declare const readMetadata: (container: Container) => Metadata;
