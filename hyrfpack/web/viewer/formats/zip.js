// Files out of a zip (PKWARE's APPNOTE): stored or deflated ones, of archives below 4 GB.

import { crc32 } from "../../hyrf/crc.js";
import { groupedDigits, quotedText } from "../../hyrf/errors.js";
import { refuseSplats } from "./checked.js";
import { Unpacker } from "./unpack.js";

const ZIP_END = 0x06054b50, ZIP_ENTRY = 0x02014b50, ZIP_LOCAL = 0x04034b50; // marks
const END_BYTES = 22, ENTRY_HEADER_BYTES = 46, LOCAL_BYTES = 30;
const LONGEST_COMMENT = 0xffff;
const STORED = 0, DEFLATED = 8; // methods
const FLAG_ENCRYPTED = 1;

/** An archive of which files are read one at a time. */
export class ZipArchive {
  /** @param {Uint8Array} bytes */
  constructor(bytes) {
    this.bytes = bytes;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
    this.entries = new Map();
    const end = this.end(), count = this.view.getUint16(end + 10, true);
    let place = this.view.getUint32(end + 16, true);
    for (let number = 0; number < count; number++) {
      if (place + ENTRY_HEADER_BYTES > end || this.view.getUint32(place, true) !== ZIP_ENTRY) damagedZip();
      const [name, extra, comment] = [28, 30, 32].map((at) => this.view.getUint16(place + at, true));
      const next = place + ENTRY_HEADER_BYTES + name + extra + comment;
      if (next > end) damagedZip();
      const title = this.bytes.subarray(place + ENTRY_HEADER_BYTES, place + ENTRY_HEADER_BYTES + name);
      this.entries.set(new TextDecoder().decode(title), place);
      place = next;
    }
  }

  // Where the record at the end of the archive stands.
  end() {
    const last = this.bytes.length - END_BYTES;
    for (let place = last; place >= Math.max(0, last - LONGEST_COMMENT); place--) {
      if (this.view.getUint32(place, true) === ZIP_END) return place;
    }
    return damagedZip();
  }

  /**
   * @param {string} name
   * @param {number} most bytes that it may have
   * @returns {Promise<Uint8Array>}
   */
  async file(name, most) {
    const place = this.entries.get(name), { view } = this;
    if (place === undefined) refuseSplats(`the zip has no ${quotedText(name)}; it is not a SOG, or damaged`);
    const [flags, method] = [8, 10].map((at) => view.getUint16(place + at, true));
    const [checksum, stored, length, local] = [16, 20, 24, 42].map((at) => view.getUint32(place + at, true));
    if (length > most) {
      refuseSplats(`${quotedText(name)} in it unpacks to ${groupedDigits(length)} bytes, far too many; it is damaged`);
    }
    if ((method !== STORED && method !== DEFLATED) || flags & FLAG_ENCRYPTED) {
      refuseSplats(`${quotedText(name)} in it is encrypted or packed by method ${method}; zip it stored or deflated`);
    }
    if (local + LOCAL_BYTES > this.bytes.length || view.getUint32(local, true) !== ZIP_LOCAL) damagedZip();
    const start = local + LOCAL_BYTES + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
    if (start + stored > this.bytes.length) damagedZip();
    const packed = this.bytes.subarray(start, start + stored);
    const content = method === STORED ? packed : await inflated(packed, length);
    if (content.length !== length || crc32(content) !== checksum) damagedZip();
    return content;
  }
}

async function inflated(packed, length) {
  const unpacker = new Unpacker(packed, "deflate-raw");
  try {
    const content = await unpacker.take(length);
    if (await unpacker.more()) damagedZip();
    return content;
  } finally {
    unpacker.close();
  }
}

const damagedZip = () => refuseSplats("the zip in it is damaged or truncated; get the file again");
