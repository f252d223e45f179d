// Prints, as JSON, what `viewpointOf` returns for each metadata in a list: `node viewpoints.mjs METADATA.json`.

import { readFile } from "node:fs/promises";

import { viewpointOf } from "../../../hyrfpack/web/hyrf/viewpoint.js";

const all = JSON.parse(await readFile(process.argv[2], "utf-8"));
console.log(JSON.stringify(all.map(viewpointOf)));
