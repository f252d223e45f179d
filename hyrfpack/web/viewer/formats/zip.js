// Reads stored and deflated files of zip archives below 4 GB (PKWARE's APPNOTE).

import { crc32 } from "../../hyrf/crc.js";
import { groupedDigits, quotedText } from "../../hyrf/errors.js";
import { rejectSplats } from "./normalize.js";
import { Unpacker } from "./unpack.js";

const END_RECORD_SIGNATURE = 0x06054b50;
const ENTRY_SIGNATURE = 0x02014b50;
const LOCAL_HEADER_SIGNATURE = 0x04034b50;
const END_RECORD_BYTES = 22;
const ENTRY_HEADER_BYTES = 46;
const LOCAL_HEADER_BYTES = 30;
const MAX_COMMENT_BYTES = 0xffff;
const METHOD_STORED = 0;
const METHOD_DEFLATED = 8;
const FLAG_ENCRYPTED = 1;

/** A zip archive whose files are read one at a time. */
export class ZipArchive {
  /** @param {Uint8Array} bytes */
  constructor(bytes) {
    this.bytes = bytes;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
    this.entries = new Map();
    const end = this.end(), count = this.view.getUint16(end + 10, true);
    let place = this.view.getUint32(end + 16, true);
    for (let number = 0; number < count; number++) {
      if (place + ENTRY_HEADER_BYTES > end || this.view.getUint32(place, true) !== ENTRY_SIGNATURE) rejectDamagedZip();
      const [name, extra, comment] = [28, 30, 32].map((at) => this.view.getUint16(place + at, true));
      const next = place + ENTRY_HEADER_BYTES + name + extra + comment;
      if (next > end) rejectDamagedZip();
      const entryName = this.bytes.subarray(place + ENTRY_HEADER_BYTES, place + ENTRY_HEADER_BYTES + name);
      this.entries.set(new TextDecoder().decode(entryName), place);
      place = next;
    }
  }

  // Returns the offset of the end-of-central-directory record.
  end() {
    const last = this.bytes.length - END_RECORD_BYTES;
    for (let place = last; place >= Math.max(0, last - MAX_COMMENT_BYTES); place--) {
      if (this.view.getUint32(place, true) === END_RECORD_SIGNATURE) return place;
    }
    return rejectDamagedZip();
  }

  /**
   * Reads and decompresses a file.
   * @param {string} name
   * @param {number} maxBytes the maximum number of decompressed bytes
   * @returns {Promise<Uint8Array>}
   */
  async file(name, maxBytes) {
    const place = this.entries.get(name), { view } = this;
    if (place === undefined) rejectSplats(`the zip has no ${quotedText(name)}; it is not a SOG, or damaged`);
    const [flags, method] = [8, 10].map((at) => view.getUint16(place + at, true));
    const [checksum, stored, length, local] = [16, 20, 24, 42].map((at) => view.getUint32(place + at, true));
    if (length > maxBytes) {
      rejectSplats(`${quotedText(name)} in it unpacks to ${groupedDigits(length)} bytes, far too many; it is damaged`);
    }
    if ((method !== METHOD_STORED && method !== METHOD_DEFLATED) || flags & FLAG_ENCRYPTED) {
      rejectSplats(`${quotedText(name)} in it is encrypted or packed by method ${method}; zip it stored or deflated`);
    }
    const isOutside = local + LOCAL_HEADER_BYTES > this.bytes.length;
    if (isOutside || view.getUint32(local, true) !== LOCAL_HEADER_SIGNATURE) rejectDamagedZip();
    const start = local + LOCAL_HEADER_BYTES + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
    if (start + stored > this.bytes.length) rejectDamagedZip();
    const packed = this.bytes.subarray(start, start + stored);
    const content = method === METHOD_STORED ? packed : await inflateRaw(packed, length);
    if (content.length !== length || crc32(content) !== checksum) rejectDamagedZip();
    return content;
  }
}

// Decompresses a deflated file of `length` bytes.
async function inflateRaw(packed, length) {
  const unpacker = new Unpacker(packed, "deflate-raw");
  try {
    const content = await unpacker.take(length);
    if (await unpacker.more()) rejectDamagedZip();
    return content;
  } finally {
    unpacker.close();
  }
}

// Throws the error for a damaged archive.
const rejectDamagedZip = () => rejectSplats("the zip in it is damaged or truncated; get the file again");
