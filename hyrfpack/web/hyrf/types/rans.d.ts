/**
 * Decodes the tokens at the start of `data`.
 * @param {Uint8Array} data
 * @param {number} count the number of tokens
 * @param {Uint8Array | null} contexts the context of each token; null if there is one context
 * @param {boolean} [mayBeStatic] whether static models are allowed
 * @returns {{tokens: Uint8Array, end: number}} `end` is the number of bytes of the tokens
 * @throws {DamagedData} the stream is damaged
 */
export declare const decodeTokens: (data: Uint8Array, count: number, contexts: Uint8Array | null, mayBeStatic?: boolean) => {
    tokens: Uint8Array;
    end: number;
};
