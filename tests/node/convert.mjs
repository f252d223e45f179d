// Runs many conversions of splat-transform in one process, because it takes half a second to start.
//
//     node convert.mjs '[["a.ply", "b.spz", "--spz-version", "3"], ["b.spz", "c.ply"]]'
//
// Each conversion is a source, a target and options of its command line. The last line printed is a JSON list with one
// entry per conversion, in order: null, or its error message. Conversions after a failed one still run.

import { syncBuiltinESMExports } from "node:module";

import { main } from "./node_modules/@playcanvas/splat-transform/dist/cli.mjs"; // the package exports no command line

class Exit extends Error {
  constructor(code) {
    super(`exit ${code}`);
    this.code = code;
  }
}

process.exit = (code) => {
  throw new Exit(code);
};
syncBuiltinESMExports();

async function convert([source, target, ...options]) {
  const messages = [];
  const write = process.stderr.write;
  process.stderr.write = (text) => messages.push(text);
  process.argv.length = 2;
  process.argv.push("--quiet", "--overwrite", "--gpu", "cpu", "--max-workers", "1", ...options, source, target);
  try {
    await main();
  } catch (error) {
    if (!(error instanceof Exit)) return String(error);
    return error.code ? messages.join("").trim() || error.message : null;
  } finally {
    process.stderr.write = write;
    process.removeAllListeners("uncaughtException").removeAllListeners("unhandledRejection");
  }
}

const answers = [];
for (const conversion of JSON.parse(process.argv[2])) answers.push(await convert(conversion));
console.log(`\n${JSON.stringify(answers)}`);
