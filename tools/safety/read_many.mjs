// Reads many files, merged ones too, with the decoder in JavaScript, for tools/safety/fuzz_browser.py and the tests.
//
//   node read_many.mjs FILES
//
// FILES holds for each file its length (u32), 1 if it is the start of a file and 0 otherwise (u8), and its bytes. The
// program prints one line of JSON for each file, where `ms` is the CPU time in milliseconds: {ms, layers, whole, groups,
// peak} with a hash of each group's float32 numbers and the peak memory up to now in bytes, {ms, refused} with the
// message of the refusal, or {ms, failed} with an unexpected error.
import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";

import { HyrfFormatError, read, readParts } from "../../hyrfpack/web/hyrf/index.js";

const hashOf = (numbers) => {
  if (!(numbers instanceof Float32Array)) throw new Error("no Float32Array");
  const bytes = new Uint8Array(numbers.buffer, numbers.byteOffset, numbers.byteLength);
  return createHash("sha256").update(bytes).digest("hex");
};

// Reads the peak memory of this process, because `resourceUsage` may include that of the parent process.
const peakBytes = () => {
  try {
    return 1024 * Number(/VmHWM:\s+(\d+) kB/.exec(readFileSync("/proc/self/status", "utf8"))[1]);
  } catch {
    return 1024 * process.resourceUsage().maxRSS; // not Linux
  }
};

const readVerdict = async (bytes, partial) => {
  const start = process.cpuUsage();
  const elapsedCpuMs = () => {
    const { user, system } = process.cpuUsage(start);
    return (user + system) / 1000;
  };
  try {
    const parts = partial ? [{ model: await read(bytes, { partial }) }] : await readParts(bytes);
    const ms = elapsedCpuMs(), { layers, whole } = parts[0].model, groups = {};
    for (const [number, { model }] of parts.entries()) {
      const { positions, colorLogits, scaleLogits, opacityLogits, geometry, radiance } = model;
      const numbers = { POSI: positions, COLO: colorLogits, SCAL: scaleLogits, OPAC: opacityLogits };
      if (model.shapeResiduals) Object.assign(numbers, { SHAP: model.shapeResiduals, HARM: model.colorResiduals });
      Object.assign(numbers, { GTAB: geometry.table, GMLP: geometry.decoder });
      Object.assign(numbers, { RTAB: radiance.table, RMLP: radiance.decoder });
      for (const [group, array] of Object.entries(numbers)) groups[number ? `${group} ${number}` : group] = hashOf(array);
    }
    return { ms, layers, whole, groups, peak: peakBytes() };
  } catch (error) {
    const ms = elapsedCpuMs();
    return error instanceof HyrfFormatError ? { ms, refused: error.message } : { ms, failed: String(error.stack) };
  }
};

const all = readFileSync(process.argv[2]);
for (let offset = 0; offset < all.length; ) {
  const length = all.readUInt32LE(offset), partial = all[offset + 4] === 1;
  const bytes = new Uint8Array(all.subarray(offset + 5, offset + 5 + length));
  console.log(JSON.stringify(await readVerdict(bytes, partial)));
  offset += 5 + length;
}
