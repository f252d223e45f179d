// The CRC-32 of zlib, gzip and PNG (polynomial 0xedb88320).

const CRC_TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
  for (let bit = 0; bit < 8; bit++) byte = byte & 1 ? (byte >>> 1) ^ 0xedb88320 : byte >>> 1;
  return byte;
});

/**
 * Computes the CRC-32 of bytes.
 * @param {Uint8Array} bytes
 * @returns {number} 0 to 2^32 - 1
 */
export const crc32 = (bytes) => {
  let crc = -1;
  for (let i = 0; i < bytes.length; i++) crc = (crc >>> 8) ^ CRC_TABLE[(crc ^ bytes[i]) & 255];
  return ~crc >>> 0;
};
