export type SceneFile = {
    file: string;
    bytes: number;
    crc32: string;
};
export type ChunkLevel = SceneFile & {
    gaussians: number;
    errors: number[];
};
export type ScenePart = SceneFile & {
    name: string;
};
export type Chunk = {
    low: number[];
    high: number[];
    levels: ChunkLevel[];
    part: number;
};
export type Manifest = {
    gaussians: number;
    parts: ScenePart[];
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
 * @throws {TypeError} `bytes` is no Uint8Array
 */
export declare const parseManifest: (bytes: Uint8Array) => Manifest;
/**
 * Returns all files of the folder but the manifest.
 * @param {Manifest} manifest
 * @returns {SceneFile[]}
 */
export declare const listFiles: ({ parts, chunks }: Manifest) => SceneFile[];
/**
 * Returns the bytes of the shared files of all parts.
 * @param {Manifest} manifest
 */
export declare const sharedBytes: ({ parts }: Manifest) => number;
