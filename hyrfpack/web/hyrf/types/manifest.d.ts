export type SceneFile = {
    file: string;
    bytes: number;
    crc32: string;
};
export type ChunkLevel = SceneFile & {
    gaussians: number;
    errors: number[];
};
export type Chunk = {
    low: number[];
    high: number[];
    levels: ChunkLevel[];
};
export type Manifest = {
    gaussians: number;
    shared: SceneFile;
    chunks: Chunk[];
    error_radii: number[];
    frame: Record<string, any>;
    background: boolean;
    solid: number[];
    viewpoint: Record<string, any>;
    cameras: number[][];
    title: string;
    licence: string;
    writer: string;
};
export declare const MAX_MANIFEST_BYTES: number;
/**
 * Parses a manifest.
 * @param {Uint8Array} bytes
 * @returns {Manifest}
 * @throws {HyrfFormatError} it is no manifest, is damaged, or has another major version
 */
export declare const parseManifest: (bytes: Uint8Array) => Manifest;
/**
 * Returns all files of the folder but the manifest.
 * @param {Manifest} manifest
 * @returns {SceneFile[]}
 */
export declare const listFiles: ({ shared, chunks }: Manifest) => SceneFile[];
