// Decompresses streams with the browser's own decompressors, and only as many bytes as are requested.

import { rejectSplats } from "./normalize.js";

/**
 * Decompresses a stream piece by piece.
 * @param {Uint8Array} bytes the compressed stream
 * @param {"gzip" | "deflate-raw" | "zstd"} how
 */
export class Unpacker {
  constructor(bytes, how) {
    let stream;
    try {
      stream = new DecompressionStream(how);
    } catch {
      rejectSplats(`it is packed by ${how}, which this browser cannot unpack; export it in another format or version`);
    }
    this.how = how;
    this.reader = new Blob([bytes]).stream().pipeThrough(stream).getReader();
    this.rest = new Uint8Array(0); // decompressed bytes that were not returned yet
  }

  /**
   * Returns the next `length` bytes, or fewer if the stream ends.
   * @param {number} length
   * @returns {Promise<Uint8Array>}
   */
  async take(length) {
    const taken = new Uint8Array(length);
    let filled = 0;
    for (;;) {
      const piece = this.rest.subarray(0, length - filled);
      taken.set(piece, filled);
      this.rest = this.rest.subarray(piece.length);
      filled += piece.length;
      if (filled === length || !(await this.more())) return taken.subarray(0, filled);
    }
  }

  /**
   * Returns whether the stream has another byte.
   * @returns {Promise<boolean>}
   */
  async more() {
    while (!this.rest.length) {
      let next;
      try {
        next = await this.reader.read();
      } catch {
        rejectSplats(`a stream of ${this.how} in it is damaged or truncated; fetch or export it again`);
      }
      if (next.done) return false;
      this.rest = next.value;
    }
    return true;
  }

  /** Ends the decompression. */
  close() {
    this.reader.cancel().catch(() => {});
  }
}
