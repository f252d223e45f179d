export declare const MAX_NESTING_DEPTH = 64;
/** A number as float64, and whether its text is an integer. */
export declare class JsonNumber {
    value: number;
    isInteger: boolean;
    /**
     * @param {string} text
     * @param {boolean} isInteger
     */
    constructor(text: string, isInteger: boolean);
}
export type JsonNode = null | boolean | string | JsonNumber | JsonNode[] | JsonObject;
export type JsonObject = Map<string, any>;
/**
 * A parsed value. Objects become maps, so that keys such as `__proto__` have no special meaning.
 * @typedef {null | boolean | string | JsonNumber | JsonNode[] | JsonObject} JsonNode
 * @typedef {Map<string, any>} JsonObject
 */
/**
 * Parses a JSON text. If a key is repeated in an object, its last value is used.
 * @param {string} text
 * @returns {JsonNode}
 * @throws {DamagedData} the text is not JSON, is nested too deeply, or has a number that is too large
 */
export declare const parseJson: (text: string) => JsonNode;
