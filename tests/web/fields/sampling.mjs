// Prints, as JSON, how finely the photos of models sampled positions: `node sampling.mjs CASES.json`. A case has the
// `metadata` of a model, local `positions` (a list of triples) and `focals` of views, in pixels.
//
// For each case it prints {sizes: the pixel size at each position, spacing: that of the background in training,
// strides: of the background in views with these focal lengths}.

import { readFile } from "node:fs/promises";

import { backgroundSpacing, backgroundStride, pixelSizes } from "../../../hyrfpack/web/hyrf/sampling.js";

const cases = JSON.parse(await readFile(process.argv[2], "utf-8"));
const found = cases.map(({ metadata, positions, focals }) => {
  const spacing = backgroundSpacing(metadata);
  const sizes = Array.from(pixelSizes(Float32Array.from(positions.flat()), metadata));
  return { sizes, spacing, strides: focals.map((focal) => backgroundStride(spacing, { fx: focal / 2, fy: focal })) };
});
console.log(JSON.stringify(found));
