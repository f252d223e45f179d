// `node viewpoints.mjs METADATA.json`: what `viewpointOf` says of each metadata in a list.

import { readFile } from "node:fs/promises";

import { viewpointOf } from "../../../hyrfpack/web/hyrf/viewpoint.js";

const all = JSON.parse(await readFile(process.argv[2], "utf-8"));
console.log(JSON.stringify(all.map(viewpointOf)));
